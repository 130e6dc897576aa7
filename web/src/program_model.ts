// A program of jobs as the page edits it: its lines, changes of them, and what is said of them.

export interface StepEnd {
  signal: string;
  task: string;
  condition: string;
}
export interface Step {
  keyword: "STEP";
  job: string;
  label: string;
  until: StepEnd[];
  seconds: number | null;
  within: number | null;
  otherwise: string;
}
export interface Goto {
  keyword: "GOTO";
  step: string;
  when: StepEnd | null;
}
export interface Repeat {
  keyword: "REPEAT";
  times: number;
}
export interface End {
  keyword: "END";
}
export interface Finish {
  keyword: "FINISH";
  failed: boolean;
  text: string;
}
export interface Order {
  keyword: "ORDER";
  command: "spawn" | "kill" | "set" | "write";
  words: string[];
}
export type Content = Step | Goto | Repeat | End | Finish | Order;
/** A line, with a number by which the page knows it while it is moved. */
export type Line = Content & { key: number };
export interface Seq {
  name: string;
  desc: string;
  safe: Step | null;
  wait: number;
  within: number | null;
  lines: Line[];
}
export interface Job {
  name: string;
  desc: string;
  pre: string[];
  post: string[];
  fault: string;
  tasks: string[];
}
export interface Listed {
  programs: string[];
  opened: string;
  jobs: Job[];
  tasks: Record<string, { signals: string[]; params: string[] }>;
  signals: string[];
  variables: string[];
  rtpus: string[];
  sbs: string;
}
/** A program as the server sends it: with the places of its lines. */
export interface SentSeq extends Omit<Seq, "lines" | "safe"> {
  file: string;
  safe: (Step & Placed) | null;
  lines: (Content & Placed)[];
}
interface Placed {
  place: { line: number } | null;
}
export interface Judged {
  seq: SentSeq | null;
  errors: string[];
  warnings: string[];
  notes: string[];
  about: string;
  first?: number;
  lost?: string[];
  comments?: boolean;
}
export interface Remark {
  severity: "error" | "warning" | "note";
  text: string;
}

let lastKey = 0;
const withoutPlace = <T extends object>(of: T): T => {
  const { place: _, ...rest } = of as T & { place?: unknown };
  return rest as T;
};
const plainStep = <T extends Content>(line: T): T => {
  const bare = withoutPlace(line);
  if (bare.keyword === "STEP") return { ...bare, until: bare.until.map(withoutPlace) };
  if (bare.keyword === "GOTO" && bare.when) return { ...bare, when: withoutPlace(bare.when) };
  return bare;
};

/** Returns a program that was opened, ready to be edited. */
export function received(sent: SentSeq): Seq {
  return {
    name: sent.name,
    desc: sent.desc,
    wait: sent.wait,
    within: sent.within,
    safe: sent.safe && plainStep(sent.safe),
    lines: sent.lines.map((one) => ({ ...plainStep(one as Content), key: ++lastKey })),
  };
}
/** Returns a program as the server takes it. */
export function sendable(seq: Seq): object {
  return { ...seq, lines: seq.lines.map(({ key: _, ...line }) => line) };
}
export const newStep = (job: string): Step => ({
  keyword: "STEP",
  job,
  label: "",
  until: [],
  seconds: null,
  within: null,
  otherwise: "",
});
export const newSeq = (name: string): Seq => ({
  name,
  desc: "",
  safe: null,
  wait: 0,
  within: null,
  lines: [],
});
export const stepName = (step: Step): string => step.label || step.job;
export const steps = (seq: Seq): Step[] =>
  seq.lines.filter((one): one is Line & Step => one.keyword === "STEP");
/** The index of the line of a step, by its name; -1 if no line, or more than one, has it. */
export function stepAt(seq: Seq, name: string): number {
  const found = seq.lines.flatMap((one, k) =>
    one.keyword === "STEP" && stepName(one) === name ? [k] : [],
  );
  return found.length === 1 ? found[0]! : -1;
}

// -- text ------------------------------------------------------------------------------

export const endText = (end: StepEnd): string =>
  end.condition ? `(${end.condition})` : [end.task, end.signal].filter(Boolean).join(" ");
export const endsText = (step: Step): string =>
  [...step.until.map(endText), ...(step.seconds === null ? [] : [`${step.seconds} s`])].join(
    " or ",
  );
export function lineText(line: Content): string {
  switch (line.keyword) {
    case "STEP":
      return `step ${stepName(line)}`;
    case "GOTO":
      return `go to ${line.step || "?"}${line.when ? ` if ${endText(line.when)}` : ""}`;
    case "REPEAT":
      return line.times ? `repeat ${line.times} times` : "repeat forever";
    case "END":
      return "end of repeat";
    case "FINISH":
      return line.failed ? "fail" : "done";
    case "ORDER":
      return [line.command, ...line.words].join(" ");
  }
}
/** The letters of an icon: the first of each word of a name, or the first ones of its only word. */
export function initials(name: string): string {
  const words = name.split(/[^A-Za-z0-9]+/).filter(Boolean);
  return (
    words.length > 1
      ? words
          .slice(0, 3)
          .map((one) => one[0])
          .join("")
      : (words[0] ?? "?").slice(0, 3)
  ).toUpperCase();
}
/** A number for a name, the same each time. */
export function hash(name: string): number {
  let found = 2166136261;
  for (const one of name) found = Math.imul(found ^ one.codePointAt(0)!, 16777619) >>> 0;
  return (found ^ (found >>> 13)) >>> 0;
}

// -- changes ---------------------------------------------------------------------------

/** Returns the program with lines put in before the one at an index. */
export function inserted(seq: Seq, at: number, ...lines: Content[]): Seq {
  const made = lines.map((one) => ({ ...one, key: ++lastKey }));
  return { ...seq, lines: seq.lines.toSpliced(at, 0, ...made) };
}
/**
 * Returns the program with one line in place of another; places where a step is named follow its
 * new name.
 */
export function replaced(seq: Seq, at: number, line: Content): Seq {
  const old = seq.lines[at]!;
  let lines: Line[] = seq.lines.with(at, { ...line, key: old.key });
  if (old.keyword === "STEP" && line.keyword === "STEP" && stepAt(seq, stepName(old)) === at) {
    const before = stepName(old),
      after = stepName(line);
    lines = lines.map((one) => {
      if (one.keyword === "GOTO" && one.step === before) return { ...one, step: after };
      return one.keyword === "STEP" && one.otherwise === before
        ? { ...one, otherwise: after }
        : one;
    });
  }
  return { ...seq, lines };
}
/** The other line of a pair REPEAT and END; -1: none. */
export function partner(seq: Seq, at: number): number {
  const open: number[] = [];
  for (const [k, one] of seq.lines.entries()) {
    if (one.keyword === "REPEAT") open.push(k);
    if (one.keyword !== "END") continue;
    const begin = open.pop() ?? -1;
    if (begin === at) return k;
    if (k === at) return begin;
  }
  return -1;
}
/** Returns the program without a line; REPEAT and its END go together. */
export function removed(seq: Seq, at: number): Seq {
  const other = partner(seq, at);
  return { ...seq, lines: seq.lines.filter((_, k) => k !== at && k !== other) };
}
/**
 * Returns the program with one line moved before the line that is at `to` now; the same if nothing
 * moves.
 */
export function moved(seq: Seq, from: number, to: number): Seq {
  if (to === from || to === from + 1 || to < 0 || to > seq.lines.length) return seq;
  const lines = seq.lines.toSpliced(from, 1);
  return { ...seq, lines: lines.toSpliced(to > from ? to - 1 : to, 0, seq.lines[from]!) };
}

// -- structure -------------------------------------------------------------------------

/** A line, or a loop with what is in it, as they are drawn. */
export interface Part {
  at: number;
  inside: Part[] | null;
  end: number;
}
export function structure(seq: Seq): Part[] {
  const top: Part[] = [];
  const open: Part[] = [];
  seq.lines.forEach((line, at) => {
    const level = open.at(-1)?.inside ?? top;
    if (line.keyword === "END" && open.length) {
      open.pop()!.end = at;
      return;
    }
    const part: Part = { at, inside: line.keyword === "REPEAT" ? [] : null, end: -1 };
    level.push(part);
    if (part.inside) open.push(part);
  });
  return top;
}
/** Ways that are not to the next line: by GOTO, and by ELSE after an error. */
export function jumps(seq: Seq): { from: number; to: number; why: "goto" | "else" }[] {
  return seq.lines.flatMap((line, from) => {
    const [name, why] =
      line.keyword === "GOTO"
        ? [line.step, "goto" as const]
        : line.keyword === "STEP"
          ? [line.otherwise, "else" as const]
          : ["", "goto" as const];
    const to = name ? stepAt(seq, name) : -1;
    return to < 0 ? [] : [{ from, to, why }];
  });
}

/** How two neighbours fit: what the first one guarantees, and what the second one demands. */
export interface Fit {
  from: string;
  to: string;
  gives: string[];
  needs: string[];
  mark: "fits" | "asked" | "conflict" | "unknown";
  text: string;
}

/** Returns how a line fits to the step before it; null where they are no neighbours. */
export function fit(seq: Seq, at: number, jobs: readonly Job[], judged: Judged | null): Fit | null {
  const line = seq.lines[at];
  if (line?.keyword !== "STEP") return null;
  let before = at - 1;
  while (before >= 0 && ["ORDER", "REPEAT", "END"].includes(seq.lines[before]!.keyword)) before--;
  const former = seq.lines[before];
  if (former?.keyword === "GOTO" && former.when) {
    while (before >= 0 && seq.lines[before]!.keyword !== "STEP") before--;
  }
  const step = seq.lines[before];
  if (step?.keyword !== "STEP") return null;
  const [one, other] = [step.job, line.job].map((name) => jobs.find((each) => each.name === name));
  if (!one || !other) return null;
  const sole = step.seconds === null && step.until.length === 1 ? step.until[0]!.condition : "";
  const found = {
    from: stepName(step),
    to: stepName(line),
    gives: [...one.post, ...(sole ? [sole] : [])],
    needs: other.pre,
  };
  if (!other.pre.length || step.job === line.job) return { ...found, mark: "fits", text: "" };
  const says = (text: string) =>
    text.includes(`POST of ${one.name} `) &&
    (text.includes(`PRE of ${other.name}:`) || text.includes(`PRE of ${other.name} `));
  const error = judged?.errors.find(says),
    warning = judged?.warnings.find(says);
  if (error ?? warning)
    return { ...found, mark: error ? "conflict" : "asked", text: said(error ?? warning!) };
  return { ...found, mark: !judged || judged.errors.length ? "unknown" : "fits", text: "" };
}

// -- what a check said -----------------------------------------------------------------

/** A text without the place at its beginning. */
export const said = (text: string): string => text.replace(/^\S+\.seq(:\d+)*:? /, "");
/** A text in which files have no folder. */
export const short = (text: string): string =>
  text.replace(/(^|[\s(])\/\S*\/(?=[^\s/]+\.\w)/g, "$1");

/**
 * Returns what was said about each line by its index, of the safe job under -1, and of none of
 * them under -2.
 */
export function remarks(judged: Judged, count: number): Map<number, Remark[]> {
  const found = new Map<number, Remark[]>();
  const lines = new Map<number, number>();
  if (judged.seq) {
    judged.seq.lines.forEach((one, k) => {
      if (one.place) lines.set(one.place.line, k);
    });
    if (judged.seq.safe?.place) lines.set(judged.seq.safe.place.line, -1);
  } else for (let k = 0; k < count; k++) lines.set((judged.first ?? 1) + k, k);
  const put = (severity: Remark["severity"]) => (text: string) => {
    const number = /^\S+\.seq:(\d+)/.exec(text)?.[1];
    const at = (number && lines.get(Number(number))) ?? -2;
    found.set(at === "" ? -2 : at, [...(found.get(at === "" ? -2 : at) ?? []), { severity, text }]);
  };
  judged.errors.forEach(put("error"));
  judged.warnings.forEach(put("warning"));
  judged.notes.forEach(put("note"));
  return found;
}
