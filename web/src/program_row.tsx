// The row of icons: a program's lines as tiles, joined by edges, with loops as frames and jumps as
// arcs.
import { useEffect, useLayoutEffect, useRef, useState } from "react";
import { JobIcon } from "./program_icon";
import { remove, shift } from "./program_forms";
import {
  endText,
  endsText,
  fit,
  inserted,
  jumps,
  lineText,
  moved,
  newStep,
  short,
  stepName,
  structure,
  type Content,
  type Line,
  type Part,
  type Remark,
  type Step,
} from "./program_model";
import { programs, usePrograms } from "./program_state";
import { useLive } from "./live_state";

/** What is dragged: a job of the list, or a line by its key. */
export const dragged: { job?: string; key?: number } = {};

/** Puts lines in after the chosen one, or at an index. */
export function add(
  label: string,
  lines: Content[],
  at = programs.at < 0 ? (programs.draft?.seq.lines.length ?? 0) : programs.at + 1,
): void {
  const seq = programs.draft?.seq;
  if (!seq) return;
  const made = inserted(seq, at, ...lines);
  programs.edit(label, made, made.lines[at]!.key);
}

function drop(at: number): void {
  const seq = programs.draft?.seq;
  const { job, key } = dragged;
  if (!seq) return;
  if (job) return add(`step ${job} added`, [newStep(job)], at);
  const from = seq.lines.findIndex((one) => one.key === key);
  if (from >= 0) programs.edit(`${lineText(seq.lines[from]!)} moved`, moved(seq, from, at), key);
}

export function ProgramRow({ told }: { told: Map<number, Remark[]> }) {
  usePrograms("draft");
  usePrograms("chosen");
  useLive("program");
  const [target, setTarget] = useState(-1);
  const box = useRef<HTMLDivElement>(null);
  const seq = programs.draft!.seq;
  const count = seq.lines.length;

  const place = (event: React.DragEvent): number => {
    const tile = (event.target as HTMLElement).closest<HTMLElement>("[data-slot]");
    if (!tile) return count;
    const at = Number(tile.dataset.slot),
      area = tile.getBoundingClientRect();
    return event.clientX < area.left + area.width / 2 ? at : at + 1;
  };
  const over = (event: React.DragEvent) => {
    if (!dragged.job && dragged.key === undefined) return;
    event.preventDefault();
    setTarget(place(event));
  };
  const keys = (event: React.KeyboardEvent) => {
    if (!(event.target as HTMLElement).matches(".tile")) return;
    const by = event.key === "ArrowRight" ? 1 : event.key === "ArrowLeft" ? -1 : 0;
    if (by && event.altKey) shift(by);
    else if (by) {
      const next = seq.lines[programs.at + by];
      if (next) programs.choose(next.key);
    } else if (event.key === "Delete" || event.key === "Backspace") remove();
    else if (event.key === "Enter")
      document
        .querySelector<HTMLElement>(".program-form select, .program-form .field input")
        ?.focus();
    else return;
    event.preventDefault();
    requestAnimationFrame(() => box.current?.querySelector<HTMLElement>(".tile.chosen")?.focus());
    if (event.key === "Enter")
      requestAnimationFrame(() =>
        document
          .querySelector<HTMLElement>(".program-form select, .program-form .field input")
          ?.focus(),
      );
  };
  const draw = (parts: Part[], end: number) => (
    <>
      {parts.map((part) =>
        part.inside ? (
          <section
            className="loop"
            key={seq.lines[part.at]!.key}
            aria-label={lineText(seq.lines[part.at]!)}
          >
            <Item at={part.at} told={told} marked={target} />
            {draw(part.inside, part.end)}
            {part.end >= 0 && <Item at={part.end} told={told} marked={target} />}
          </section>
        ) : (
          <Item at={part.at} key={seq.lines[part.at]!.key} told={told} marked={target} />
        ),
      )}
      {end === count && (
        <div className={`slot-end${target === count ? " here" : ""}`}>
          {count ? "" : "Drag jobs here, or choose them in the list: each becomes a step."}
        </div>
      )}
    </>
  );
  return (
    <div
      ref={box}
      className="program-row"
      role="group"
      aria-label={`the program ${programs.name}`}
      onKeyDown={keys}
      onDragOver={over}
      onDragLeave={(event) => {
        if (event.target === box.current) setTarget(-1);
      }}
      onDrop={(event) => {
        event.preventDefault();
        setTarget(-1);
        drop(place(event));
      }}
    >
      <Arcs />
      {draw(structure(seq), count)}
    </div>
  );
}

/** One line: the edge from the one before, and its tile. */
function Item({ at, told, marked }: { at: number; told: Map<number, Remark[]>; marked: number }) {
  const draft = programs.draft!,
    line = draft.seq.lines[at]!;
  const edge = fit(draft.seq, at, programs.listed?.jobs ?? [], draft.judged);
  const remarks = told.get(at) ?? [];
  return (
    <div className={`item${marked === at ? " here" : ""}`} data-slot={at}>
      {at > 0 &&
        (edge ? (
          <Edge of={edge} />
        ) : (
          <span className="edge plain" aria-hidden="true">
            {comesFrom(at) ? "→" : ""}
          </span>
        ))}
      <Tile line={line} remarks={remarks} first={at === 0} />
    </div>
  );
}

/** Whether the line before may lead on to this one. */
function comesFrom(at: number): boolean {
  const before = programs.draft!.seq.lines[at - 1]!;
  return !(before.keyword === "FINISH" || (before.keyword === "GOTO" && !before.when));
}

const MARKS = { fits: "✓", asked: "?", conflict: "✕", unknown: "…" };
const MEANINGS = {
  fits: "it fits",
  asked: "not ensured: asked when the step begins",
  conflict: "they can never hold together",
  unknown: "compared when the faults are put right",
};

function Edge({ of }: { of: NonNullable<ReturnType<typeof fit>> }) {
  const text = `${of.from} guarantees: ${of.gives.join(", ") || "nothing"}\n${of.to} demands: ${of.needs.join(", ") || "nothing"}\n${MEANINGS[of.mark]}`;
  return (
    <span
      className={`edge edge-${of.mark}`}
      role="img"
      title={of.text ? `${text}\n${of.text}` : text}
      aria-label={text}
    >
      <small className="gives">{of.gives.join(", ")}</small>
      <span className="shaft">
        <i>{MARKS[of.mark]}</i>
      </span>
      <small className="needs">{of.needs.join(", ")}</small>
    </span>
  );
}

const GLYPHS = { GOTO: "↷", REPEAT: "↻", END: "↺", FINISH: "■", ORDER: "›" };

/** The mark of the line that runs or comes next; brings it into sight when that begins. */
export function Lit() {
  const place = useRef<HTMLSpanElement>(null);
  useEffect(() => {
    place.current?.parentElement?.scrollIntoView({ block: "nearest" });
  }, []);
  return (
    <span ref={place} className="tile-runs" aria-hidden="true">
      {programs.isPaused ? "❚❚" : "▶"}
    </span>
  );
}

function Tile({ line, remarks, first }: { line: Line; remarks: Remark[]; first: boolean }) {
  const chosen = programs.chosen === line.key;
  const worst =
    remarks.find((one) => one.severity === "error") ??
    remarks.find((one) => one.severity === "warning");
  const lit = programs.lit === line.key;
  const kind =
    line.keyword === "STEP"
      ? "step"
      : line.keyword === "FINISH" && line.failed
        ? "small fail"
        : "small";
  const about = [
    lineText(line),
    line.keyword === "STEP" && endsText(line) && `until ${endsText(line)}`,
    lit && (programs.isPaused ? "comes next" : "runs now"),
    ...remarks.map((one) => `${one.severity}: ${short(one.text)}`),
  ]
    .filter(Boolean)
    .join("; ");
  return (
    <button
      type="button"
      className={`tile ${kind} kind-${line.keyword.toLowerCase()}${chosen ? " chosen" : ""}${lit ? " lit" : ""}${worst ? ` has-${worst.severity}` : ""}`}
      data-key={line.key}
      draggable
      aria-pressed={chosen}
      aria-label={about}
      title={remarks.map((one) => short(one.text)).join("\n") || undefined}
      aria-current={lit ? "step" : undefined}
      tabIndex={chosen || (first && programs.at < 0) ? 0 : -1}
      onClick={() => programs.choose(line.key)}
      onFocus={() => {
        if (!chosen) programs.choose(line.key);
      }}
      onDragStart={(event) => {
        dragged.key = line.key;
        event.dataTransfer.effectAllowed = "move";
        event.dataTransfer.setData("text/plain", lineText(line));
      }}
      onDragEnd={() => {
        delete dragged.key;
      }}
    >
      {line.keyword === "STEP" ? <StepFace step={line} /> : <OtherFace line={line} />}
      {worst?.severity === "error" && (
        <span className="tile-fault" aria-hidden="true">
          ✕
        </span>
      )}
      {lit && <Lit />}
    </button>
  );
}

export function StepFace({ step }: { step: Step }) {
  const job = programs.listed?.jobs.find((one) => one.name === step.job);
  const until = endsText(step);
  return (
    <>
      <JobIcon job={step.job} faulty={Boolean(job?.fault) || (Boolean(programs.listed) && !job)} />
      <b>{stepName(step)}</b>
      {step.label && <small>{step.job}</small>}
      <small className="until">
        {until ? `until ${until}` : "ends at once"}
        {step.within !== null && ` ≤ ${step.within} s`}
      </small>
      {step.otherwise && <small className="else">▲ else {step.otherwise}</small>}
    </>
  );
}

function OtherFace({ line }: { line: Exclude<Content, Step> }) {
  return (
    <>
      <span className="glyph" aria-hidden="true">
        {line.keyword === "FINISH" ? (line.failed ? "✕" : "✓") : GLYPHS[line.keyword]}
      </span>
      {line.keyword === "GOTO" ? (
        <>
          <b>go to {line.step || "?"}</b>
          {line.when && <small className="until">if {endText(line.when)}</small>}
        </>
      ) : line.keyword === "ORDER" ? (
        <>
          <b>{line.command}</b>
          <small className="until">{line.words.join(" ")}</small>
        </>
      ) : line.keyword === "FINISH" ? (
        <>
          <b>{line.failed ? "fail" : "done"}</b>
          <small>{line.text}</small>
        </>
      ) : (
        <b>{lineText(line)}</b>
      )}
    </>
  );
}

interface Arc {
  path: string;
  why: "goto" | "else";
  near: boolean;
}

/** Lines behind the tiles, from each GOTO and ELSE to its step. */
function Arcs() {
  usePrograms("draft");
  usePrograms("chosen");
  const [arcs, setArcs] = useState<Arc[]>([]);
  const [size, setSize] = useState(0);
  const own = useRef<SVGSVGElement>(null);
  const seq = programs.draft!.seq;
  useLayoutEffect(() => {
    const seen = new ResizeObserver(() => setSize((one) => one + 1));
    if (own.current) seen.observe(own.current);
    return () => seen.disconnect();
  }, []);
  useLayoutEffect(() => {
    const box = own.current?.parentElement;
    const area = box?.getBoundingClientRect();
    const middle = (at: number) => {
      const tile = box
        ?.querySelector(`.tile[data-key="${seq.lines[at]!.key}"]`)
        ?.getBoundingClientRect();
      return tile && area && { x: tile.x - area.x + tile.width / 2, y: tile.bottom - area.y };
    };
    setArcs(
      jumps(seq).flatMap(({ from, to, why }) => {
        const a = middle(from),
          b = middle(to);
        if (!a || !b) return [];
        const side = why === "else" ? 9 : -9,
          deep = 26;
        const near = [seq.lines[from]!.key, seq.lines[to]!.key].includes(programs.chosen as number);
        return [
          {
            path: `M${a.x + side} ${a.y}C${a.x + side} ${a.y + deep} ${b.x + side} ${b.y + deep + 4} ${b.x + side} ${b.y + 3}`,
            why,
            near,
          },
        ];
      }),
    );
  }, [seq, programs.chosen, size]);
  return (
    <svg ref={own} className="arcs" aria-hidden="true">
      <defs>
        {(["goto", "else"] as const).map((one) => (
          <marker
            key={one}
            id={`arc-${one}`}
            viewBox="0 0 8 8"
            refX="7"
            refY="4"
            markerWidth="7"
            markerHeight="7"
            orient="auto"
          >
            <path className={`arc-${one}`} d="M0 0 8 4 0 8Z" />
          </marker>
        ))}
      </defs>
      {arcs.map((one, k) => (
        <path
          key={k}
          className={`arc arc-${one.why}${one.near ? " near" : ""}`}
          d={one.path}
          markerEnd={`url(#arc-${one.why})`}
        />
      ))}
    </svg>
  );
}
