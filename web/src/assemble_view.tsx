// The engineer's level: a job is put together from modules of the library.
export function AssembleView() {
  return <main className="assemble" />;
}
