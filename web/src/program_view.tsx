// The application level: jobs put in a row are a program.
export function ProgramView() {
  return <main className="program" />;
}
