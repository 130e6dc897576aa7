// The application level: jobs put in a row are a program.
import { useEffect, useMemo, useState } from "react";
import { program } from "./connection";
import { live, useLive } from "./live_state";
import { FormPanel, NewName } from "./program_forms";
import { JobIcon } from "./program_icon";
import {
  newStep,
  remarks,
  said,
  short,
  steps,
  stepName,
  type Content,
  type Job,
} from "./program_model";
import { Lit, ProgramRow, StepFace, add, dragged } from "./program_row";
import { Refusal } from "./program_run";
import { ENDED, programs, usePrograms } from "./program_state";
import type { Answer } from "./protocol";

export function ProgramView() {
  usePrograms("draft");
  usePrograms("list");
  useLive("link");
  useEffect(() => {
    if (live.link === "live") void programs.list();
  }, []);
  useEffect(() => {
    const pressed = (event: KeyboardEvent) => {
      if (!(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z" || event.altKey)
        return;
      // The field's own undo
      if ((event.target as HTMLElement).matches?.("[data-typed], .new-name input")) return;
      event.preventDefault();
      if (event.shiftKey) programs.redo();
      else programs.undo();
    };
    window.addEventListener("keydown", pressed);
    return () => window.removeEventListener("keydown", pressed);
  }, []);
  const draft = programs.draft;
  const told = useMemo(
    () =>
      remarks(
        draft?.judged ?? { seq: null, errors: [], warnings: [], notes: [], about: "" },
        draft?.judgedSeq?.lines.length ?? 0,
      ),
    [draft?.judged],
  );
  // What was said belongs to lines as they were then: it stays at them when others move.
  const shown = useMemo(() => {
    if (!draft?.judgedSeq || draft.judgedSeq === draft.seq) return told;
    const place = new Map(draft.seq.lines.map((one, k) => [one.key, k]));
    return new Map(
      [...told].flatMap(([at, what]) => {
        const key = draft.judgedSeq!.lines[at]?.key;
        const now = at < 0 ? at : key === undefined ? undefined : place.get(key);
        return now === undefined ? [] : [[now, what] as const];
      }),
    );
  }, [told, draft?.seq]);
  return (
    <main className="program">
      <Palette />
      {draft ? (
        <section className="program-page" aria-label="program">
          <Tools />
          <div className="program-canvas">
            <ProgramRow told={shown} />
            <SafeTile />
          </div>
          <Verdict />
        </section>
      ) : (
        <section className="program-page empty">
          <p>
            Open a program from the list, or begin a new one: it is a row of jobs, one after the
            other.
          </p>
        </section>
      )}
      <aside className="side program-form" aria-label="form" key={programs.name}>
        {draft && <Form told={shown} />}
      </aside>
    </main>
  );
}

function Form({ told }: { told: ReturnType<typeof remarks> }) {
  usePrograms("chosen");
  return (
    <>
      <div className="row form-choice">
        <button
          type="button"
          aria-pressed={programs.chosen === "program"}
          onClick={() => programs.choose("program")}
        >
          program
        </button>
        <button
          type="button"
          aria-pressed={programs.chosen === "safe"}
          onClick={() => programs.choose("safe")}
        >
          safe job
        </button>
      </div>
      <FormPanel said={told} />
    </>
  );
}

// -- programs and jobs to choose from --------------------------------------------------

function Palette() {
  const [answer, setAnswer] = useState<Answer | null>(null);
  const [known, setKnown] = useState("");
  const names = [
    ...new Set([...(programs.listed?.programs ?? []), ...programs.drafts.keys()]),
  ].sort();
  const begin = (name: string) => {
    setAnswer(null);
    setKnown(
      names.includes(name) ? `there is a program ${name} already: choose it in the list` : "",
    );
    if (!names.includes(name)) void programs.begin(name).then(setAnswer);
  };
  const open = (name: string) => {
    setAnswer(null);
    setKnown("");
    void programs.open(name).then(setAnswer);
  };
  return (
    <nav className="program-list" aria-label="programs and jobs">
      <h3>programs</h3>
      {programs.refusal && (
        <p className="refused" role="alert">
          {programs.refusal}
        </p>
      )}
      <ul className="program-names">
        {names.map((name) => {
          const draft = programs.drafts.get(name);
          return (
            <li key={name}>
              <button
                type="button"
                aria-pressed={name === programs.name}
                onClick={() => open(name)}
              >
                {name}
                {draft && programs.isUnsaved(draft) && (
                  <span className="unsaved-mark" title="has changes that are not saved">
                    {" "}
                    ● unsaved
                  </span>
                )}
              </button>
            </li>
          );
        })}
      </ul>
      <NewName begin={begin} />
      {known && (
        <p className="refused" role="alert">
          {known}
        </p>
      )}
      <Refusal of={answer} close={() => setAnswer(null)} />
      <h3>jobs</h3>
      <ul className="jobs">
        {programs.listed?.jobs.map((one) => (
          <li key={one.name}>
            <JobButton job={one} />
          </li>
        ))}
      </ul>
      {programs.listed && !programs.listed.jobs.length && (
        <p className="dim">There is no .job file beside {programs.listed.sbs}.</p>
      )}
      <h3>other lines</h3>
      <div className="row wrap others">
        {OTHERS.map(([label, help, lines]) => (
          <button
            key={label}
            type="button"
            title={help}
            disabled={!programs.draft}
            onClick={() => add(`${label} added`, lines)}
          >
            {label}
          </button>
        ))}
      </div>
    </nav>
  );
}

const OTHERS: [string, string, Content[]][] = [
  [
    "go to",
    "another step follows, always or in one case",
    [{ keyword: "GOTO", step: "", when: null }],
  ],
  [
    "repeat",
    "the lines up to its end are done several times",
    [{ keyword: "REPEAT", times: 2 }, { keyword: "END" }],
  ],
  [
    "command",
    "spawn, kill, set or write, as at the prompt",
    [{ keyword: "ORDER", command: "spawn", words: [] }],
  ],
  ["done", "the program ends", [{ keyword: "FINISH", failed: false, text: "" }]],
  ["fail", "the program ends, and has failed", [{ keyword: "FINISH", failed: true, text: "" }]],
];

function JobButton({ job }: { job: Job }) {
  const about = [
    job.desc,
    ...job.pre.map((one) => `PRE  ${one}`),
    ...job.post.map((one) => `POST ${one}`),
  ]
    .filter(Boolean)
    .join("\n");
  return (
    <>
      <button
        type="button"
        className="job"
        draggable={!job.fault && Boolean(programs.draft)}
        disabled={Boolean(job.fault) || !programs.draft}
        title={about}
        onClick={() => add(`step ${job.name} added`, [newStep(job.name)])}
        onDragStart={(event) => {
          dragged.job = job.name;
          event.dataTransfer.effectAllowed = "copy";
          event.dataTransfer.setData("text/plain", job.name);
        }}
        onDragEnd={() => {
          delete dragged.job;
        }}
      >
        <JobIcon job={job.name} faulty={Boolean(job.fault)} />
        <span>
          <b>{job.name}</b>
          <small>{job.desc}</small>
        </span>
      </button>
      {job.fault && <p className="refused">{short(job.fault)}</p>}
    </>
  );
}

// -- what is done with the program -----------------------------------------------------

/** Gives a file to the browser. */
function download(name: string, text: string): void {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/x-python" }));
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
}

function Tools() {
  usePrograms("draft");
  usePrograms("check");
  useLive("program");
  useLive("link");
  const draft = programs.draft!;
  const [done, setDone] = useState<{ what: string; answer: Answer; said: string } | null>(null);
  const [busy, setBusy] = useState(false);
  const unsaved = programs.unsaved(draft);
  const lost = draft.judged?.lost ?? [];
  const act = async (
    what: string,
    doing: () => Promise<Answer | null>,
    saying: (answer: Answer) => string,
  ) => {
    setBusy(true);
    setDone(null);
    const answer = await doing();
    setBusy(false);
    if (answer) setDone({ what, answer, said: answer.ok ? saying(answer) : "" });
  };
  const saved = (answer: Answer) => {
    const data = answer.data as { written: string[]; lost: string[] };
    const files = data.written.map((one) => one.replace(/.*\//, "")).join(", ");
    return files
      ? `saved: ${files}${data.lost.length ? `; without the comments: ${data.lost.join("; ")}` : ""}`
      : "nothing had changed in the file";
  };
  const first = unsaved.length ? "save and " : "";
  const run = (paused: boolean) =>
    act(
      "run",
      async () => (await programs.saved()) ?? program("run", { name: draft.name, paused }),
      () => "",
    );
  const exported = () =>
    act(
      "export",
      async () => (await programs.saved()) ?? program("export", { name: draft.name }),
      (answer) => {
        const { file, text } = answer.data as { file: string; text: string };
        download(file, text);
        return `downloaded: ${file}; it belongs beside ${programs.listed?.sbs ?? "the jobs"}`;
      },
    );
  const runs = Boolean(live.running) && !ENDED.has(live.running!.state.phase);
  const off = busy || live.link !== "live";
  return (
    <header className="program-tools">
      <div className="row wrap">
        <h2>{draft.name}</h2>
        <button
          type="button"
          className="primary"
          disabled={off || runs}
          onClick={() => void run(false)}
          title={runs ? "a program runs already" : "run the saved program on the subsystem"}
        >
          <span aria-hidden="true">▶ </span>
          {first}run
        </button>
        <button
          type="button"
          disabled={off || runs}
          onClick={() => void run(true)}
          title="begin with a pause, to go step by step"
        >
          {first}run paused
        </button>
        <span className="gap" />
        <button
          type="button"
          disabled={!draft.past.length}
          onClick={() => programs.undo()}
          aria-keyshortcuts="Control+Z"
          title={draft.past.length ? `take back: ${draft.past.at(-1)!.label}` : ""}
        >
          undo
        </button>
        <button
          type="button"
          disabled={!draft.future.length}
          onClick={() => programs.redo()}
          aria-keyshortcuts="Control+Shift+Z"
          title={draft.future.length ? `do again: ${draft.future[0]!.label}` : ""}
        >
          redo
        </button>
        <span className="gap" />
        <button
          type="button"
          disabled={off || !unsaved.length}
          onClick={() => void act("save", () => programs.save(), saved)}
        >
          save
        </button>
        <button type="button" disabled={off} onClick={() => void exported()}>
          {first}export as Python
        </button>
      </div>
      {unsaved.length > 0 && (
        <p className="unsaved">
          <b>not saved:</b> {unsaved.length > 4 ? `${unsaved.length} changes, last ` : ""}
          {unsaved.slice(-4).join(", ")}
        </p>
      )}
      {unsaved.length > 0 && lost.length > 0 && (
        <p className="unsaved">
          Saving drops {lost.length === 1 ? "a comment" : `${lost.length} comments`} of the file:{" "}
          {lost.join("; ")}
        </p>
      )}
      {done && !done.answer.ok && <Refusal of={done.answer} close={() => setDone(null)} />}
      {done && !done.answer.ok && done.answer.text.includes("since it was opened") && (
        <p className="row">
          <button
            type="button"
            onClick={() =>
              void act(
                "open",
                () => programs.reread(),
                () => "the file was read again; undo brings back what you had",
              )
            }
          >
            open it again
          </button>
          <span className="dim">undo brings your changes back</span>
        </p>
      )}
      {done?.answer.ok && done.said && (
        <p className="outcome done" role="status">
          {done.said}
          <button
            type="button"
            className="close"
            onClick={() => setDone(null)}
            aria-label="close this message"
          >
            ×
          </button>
        </p>
      )}
    </header>
  );
}

/** The safe job, after the row. */
function SafeTile() {
  usePrograms("chosen");
  useLive("program");
  const safe = programs.draft!.seq.safe;
  const lit = programs.lit === "safe";
  return (
    <div className="safe-place">
      <small>after an abort, or an error that no ELSE takes</small>
      <button
        type="button"
        className={`tile step safe${lit ? " lit" : ""}${programs.chosen === "safe" ? " chosen" : ""}`}
        aria-pressed={programs.chosen === "safe"}
        aria-current={lit ? "step" : undefined}
        onClick={() => programs.choose("safe")}
      >
        {safe ? (
          <StepFace step={safe} />
        ) : (
          <>
            <span className="glyph" aria-hidden="true">
              +
            </span>
            <b>no safe job</b>
            <small>the present job stays</small>
          </>
        )}
        {lit && <Lit />}
      </button>
    </div>
  );
}

/** What the check behind each edit has found, in words. */
function Verdict() {
  usePrograms("check");
  usePrograms("draft");
  const draft = programs.draft!,
    judged = draft.seq.lines.length && draft.judgedSeq?.lines.length ? draft.judged : null;
  const count = judged?.errors.length ?? 0;
  const mine = judged?.seq?.file.replace(/.*\//, "");
  const what = judged
    ? remarks(judged, draft.judgedSeq?.lines.length ?? 0)
    : new Map<number, never>();
  const flat = [...what].flatMap(([at, list]) =>
    list.map((one: { severity: string; text: string }) => ({ ...one, at })),
  );
  const order = ["error", "warning", "note"];
  flat.sort((a, b) => order.indexOf(a.severity) - order.indexOf(b.severity) || a.at - b.at);
  const name = (at: number) => {
    const line = draft.judgedSeq?.lines[at];
    return at === -1 ? "safe job" : line?.keyword === "STEP" ? stepName(line) : `line ${at + 1}`;
  };
  const list = (of: typeof flat) => (
    <ul>
      {of.map((one) => (
        <li key={`${one.at} ${one.text}`} className={`remark-${one.severity}`}>
          <span className="sign">{one.severity}</span>
          {one.at >= -1 && (
            <button
              type="button"
              className="link"
              onClick={() =>
                programs.choose(
                  one.at === -1 ? "safe" : (draft.judgedSeq?.lines[one.at]?.key ?? "program"),
                )
              }
            >
              {name(one.at)}
            </button>
          )}
          <pre>{short(one.at >= -1 ? said(one.text) : one.text)}</pre>
        </li>
      ))}
    </ul>
  );
  const state = programs.checking
    ? "checking"
    : draft.refusal
      ? "faulty"
      : count
        ? "faulty"
        : judged
          ? "good"
          : "empty";
  return (
    <footer className={`verdict verdict-${state}`} aria-label="check">
      <p role="status">
        <b>
          {programs.checking
            ? "… checking"
            : draft.refusal
              ? "✕ not checked"
              : count
                ? `✕ ${count === 1 ? "1 fault" : `${count} faults`}`
                : judged
                  ? "✓ no fault"
                  : ""}
        </b>{" "}
        <span className="dim">
          {draft.seq.lines.length
            ? `${steps(draft.seq).length} ${steps(draft.seq).length === 1 ? "step" : "steps"}`
            : "no step yet"}
          {mine && ` in ${mine}`}
        </span>
      </p>
      {draft.refusal && <pre className="remark remark-error">{draft.refusal}</pre>}
      {list(flat.filter((one) => one.severity === "error"))}
      {flat.length > count && (
        <details>
          <summary>
            {flat.length - count === 1 ? "one remark" : `${flat.length - count} remarks`}
          </summary>
          {list(flat.filter((one) => one.severity !== "error"))}
        </details>
      )}
    </footer>
  );
}
