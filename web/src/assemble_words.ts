// What the assembling part of the page works out from the job that is edited: pure, for tests.
import type {
  EditorState,
  Fault,
  Fit,
  Graph,
  LibraryModule,
  Offer,
  Port,
  TimingBar,
} from "./protocol";

/** Returns the first sentence of a fault: without its place, and without what was expected. */
export function faultHead(text: string): string {
  const told = text.replace(/^\S+?:(\d+:)*\s/, "");
  const end = /\s\((?:expected|got)\s|;\s/.exec(told);
  return end ? told.slice(0, end.index) : told;
}

export interface NumberedFault {
  number: number;
  fault: Fault;
  offers: Offer[];
}
/** Returns the faults with what would put each right; those that prevent a start come first. */
export function faultsOf(state: EditorState): NumberedFault[] {
  const all = state.graph.faults.map((fault, number) => ({
    number,
    fault,
    offers: state.offers.filter((one) => one.faults.includes(number)),
  }));
  return [
    ...all.filter((one) => one.fault.severity !== "warn"),
    ...all.filter((one) => one.fault.severity === "warn"),
  ];
}

/** Returns the modules of the library as what can be added: by class, each class sorted. */
export function groupModules(
  modules: readonly LibraryModule[],
): [string, { rmod: string; module: LibraryModule }[]][] {
  const groups = new Map<string, { rmod: string; module: LibraryModule }[]>();
  for (const module of modules) {
    const names = module.rmods.length
      ? module.rmods.map((one) => one.replace(/^.*\//, "").replace(/\.rmod$/, ""))
      : [module.name];
    const group = groups.get(module.module_class) ?? [];
    group.push(...[...new Set(names)].map((rmod) => ({ rmod, module })));
    groups.set(module.module_class, group);
  }
  for (const group of groups.values()) group.sort((a, b) => a.rmod.localeCompare(b.rmod));
  return [...groups].sort(([a], [b]) => a.localeCompare(b));
}

/** The port from which a connection is made, and what fits it. */
export interface Connecting {
  task: string;
  port: string;
  fits: readonly Fit[];
}
/**
 * Returns why a port cannot be connected to the one from which a connection is made; empty: it
 * can.
 */
export function misfit(graph: Graph, from: Connecting, task: string, port: string): string {
  if (task === from.task) return port === from.port ? "" : `it is of ${task}, too`;
  const found = from.fits.find((one) => one.task === task && one.port === port);
  if (found) return found.fits ? "" : found.reason || "it does not fit";
  const isInput = (of: string, name: string) =>
    graph.tasks.find((one) => one.name === of)?.ins.some((one) => one.port === name) ?? false;
  return `both are ${isInput(from.task, from.port) ? "inputs" : "outputs"}`;
}

/** Returns the tasks that one state has and another has not. */
export function newTasks(before: Graph | null, after: Graph): string[] {
  const known = new Set(before?.tasks.map((one) => one.name));
  return after.tasks.map((one) => one.name).filter((one) => !known.has(one));
}

/** Returns a port of a task by one of its names: that in the module, or its variable. */
export function portOf(
  graph: Graph,
  task: string,
  name: string,
): { port: Port; isInput: boolean } | null {
  const about = graph.tasks.find((one) => one.name === task);
  const named = (one: Port) => one.port === name;
  const input = about?.ins.find(named),
    output = about?.outs.find(named);
  if (input) return { port: input, isInput: true };
  return output ? { port: output, isInput: false } : null;
}

/** Returns how far a load fills its bar, and where its bound is, in percent of the bar. */
export function barOf(one: TimingBar): { filled: number; bound: number; over: boolean } {
  const used = one.utilization ?? 0,
    bound = one.bound ?? 1,
    whole = Math.max(1, used, bound);
  return { filled: (100 * used) / whole, bound: (100 * bound) / whole, over: used > bound };
}

/** Returns the lines of a diff, each with what it is. */
export function diffLines(
  diff: string,
): { kind: "added" | "removed" | "place" | "same"; text: string }[] {
  const lines = diff.split("\n").slice(2); // the names of the file come first
  if (lines.at(-1) === "") lines.pop();
  return lines.map((text) => ({
    kind: text.startsWith("+")
      ? "added"
      : text.startsWith("-")
        ? "removed"
        : text.startsWith("@")
          ? "place"
          : "same",
    text,
  }));
}

/** Returns what another browser has done to the job; empty: nothing that can be seen. */
export function doneElsewhere(before: EditorState, after: EditorState): string {
  if (before.file !== after.file)
    return `opened ${jobName(after.file)} instead of ${jobName(before.file)}${
      before.unsaved.length ? `, without saving ${before.unsaved.map(fileName).join(", ")}` : ""
    }`;
  if (before.unsaved.length && !after.unsaved.length && before.undo === after.undo)
    return "saved the job";
  if (after.redo && after.redo !== before.redo && before.undo === after.redo)
    return `took back: ${after.redo}`;
  return after.undo && (after.undo !== before.undo || after.graph !== before.graph)
    ? `changed the job: ${after.undo}`
    : "";
}

/** Returns the name of a file without its folder, and of a job without its ending. */
export const fileName = (path: string): string => path.replace(/^.*\//, "");
export const jobName = (path: string): string => fileName(path).replace(/\.job$/, "");

/**
 * Returns numbers of a text, as INIT, MIN and MAX have them; null: none. Throws a sentence for the
 * user.
 */
export function numbersOf(text: string): number[] | null {
  const words = text
    .trim()
    .split(/[\s,]+/)
    .filter(Boolean);
  for (const one of words)
    if (!Number.isFinite(Number(one))) throw new Error(`${one} is no number`);
  return words.length ? words.map(Number) : null;
}
