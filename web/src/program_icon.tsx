// The icon of a job: a coloured shape with the letters of its name, the same for a name each time.
import { hash, initials } from "./program_model";

const SHAPES = [
  <circle key="0" cx="24" cy="24" r="21" />,
  <rect key="1" x="4" y="4" width="40" height="40" rx="9" />,
  <path key="2" d="M24 2 46 24 24 46 2 24Z" />,
  <path key="3" d="M13 4h22l11 20-11 20H13L2 24Z" />,
  <path key="4" d="M24 3 44 10v18c0 9-9 15-20 18C13 43 4 37 4 28V10Z" />,
  <path key="5" d="M14 4h20l10 10v20L34 44H14L4 34V14Z" />,
];

export function JobIcon({ job, faulty = false }: { job: string; faulty?: boolean }) {
  const number = hash(job);
  return (
    <svg
      className={`job-icon${faulty ? " faulty" : ""}`}
      viewBox="0 0 48 48"
      aria-hidden="true"
      style={{ "--hue": `${((number >>> 8) % 12) * 30}` } as React.CSSProperties}
    >
      {SHAPES[number % SHAPES.length]}
      <text x="24" y="24.5">
        {faulty ? "!" : initials(job)}
      </text>
    </svg>
  );
}
