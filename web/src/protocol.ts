// The messages between the page and its server, as docs and server define them.

export type State = "OFF" | "ON" | "ERROR" | "NOT-CREATED";
export type Role = "operator" | "observer";
export type Severity = "debug" | "info" | "warning" | "error" | "fatal";
export type Field = string | number | boolean | null;

export interface Arg {
  name: string;
  kind: string;
  doc: string;
  use: string;
  last: boolean;
}
export interface Command {
  name: string;
  usage: string;
  help: string;
  changes: boolean;
  examples: [string, string][];
  args: Arg[];
}
export interface FieldInfo {
  name: string;
  unit: string;
  doc: string;
}
export interface LogInfo {
  file: string;
  begin: number;
  end: number;
}
export interface Hello {
  kind: "hello";
  role: Role;
  name: string;
  job: string;
  version: string;
  now: number;
  commands: Command[];
  fields: FieldInfo[];
  log: LogInfo | null;
}

export interface Port {
  port: string;
  variable: string;
  constant: boolean;
  unit: string;
  shape: (number | string)[];
  type: string;
}
export interface ParamInfo {
  name: string;
  unit: string;
  desc: string;
  type: string;
  bounds: string;
  shape: number[];
  low: number | null;
  high: number | null;
  value: unknown;
}
export interface TaskInfo {
  name: string;
  module: string;
  class: string;
  desc: string;
  rtpu: string;
  freq: number;
  type: string;
  crit: string;
  fallback_of: string;
  parts: string[];
  devices: string[];
  ins: Port[];
  outs: Port[];
  params: ParamInfo[];
  rmod_file: string;
}
export interface Variable {
  name: string;
  desc: string;
  unit: string;
  type: string;
  shape: number[];
  n: number;
  constant: boolean;
  writers: string[];
  readers: string[];
}
export interface Wire {
  variable: string;
  from: string;
  to: string;
  constant: boolean;
}
export interface Link {
  name: string;
  task: string;
  variable: string;
  direction: "in" | "out";
  to: string;
  from: string;
}
export interface Fault {
  text: string;
  severity: "refuse" | "warn";
  tasks: string[];
  variables: string[];
  ports: string[];
  remedy: string;
}
export interface Graph {
  name: string;
  job: string;
  rtpus: { name: string; scheduler: string; keeper: boolean }[];
  tasks: TaskInfo[];
  variables: Variable[];
  wires: Wire[];
  links: Link[];
  faults: Fault[];
  /** Tasks of the present job that do not exist, and why; only of a subsystem that is watched. */
  missing?: Record<string, string>;
}

export interface TaskStatus {
  task: string;
  rtpu: string;
  state: State;
  signals: string[];
  fields: Record<string, Field>;
  error: string;
  warning: string;
  waits: string;
  standby: boolean;
  fallback_of: string;
  restarted: string;
}
export interface RtpuStatus {
  rtpu: string;
  illegal: string[];
  silent: boolean;
  /** Missing in a recorded run, and where the RTPU has never answered. */
  backend?: string;
  scheduler?: string;
  util?: number;
  dispatcher?: number;
  stalls?: number;
  /** Seconds since the last stall: 0 while one lasts, null if there was none. */
  stall_age?: number | null;
  load?: number;
}
/** Its time and age are null if it was never written. */
export interface Value {
  t: number | null;
  v: (number | null)[];
  writer: string;
  age: number | null;
  stale: boolean;
}
export interface PbonetEvent {
  n: number;
  t: number;
  task: string;
  rtpu: string;
  severity: Severity;
  code: string;
  text: string;
}

export interface StatusMessage {
  kind: "status";
  t: number;
  whole: boolean;
  rtpus: RtpuStatus[];
  tasks: TaskStatus[];
  gone: string[];
}
export interface Answer {
  kind: "answer";
  id: number;
  ok: boolean;
  text: string;
  warnings: string[];
  data: Record<string, unknown> | null;
}
/** One way to put faults right; `faults` are their places in the graph's list. */
export interface Offer {
  faults: number[];
  kind: string;
  text: string;
  steps: unknown[];
}
/** The job that is edited, as the server judges it. */
export interface EditorState {
  file: string;
  jobs?: string[];
  graph: Graph;
  legal: boolean;
  errors: string[];
  warnings: string[];
  timing: TimingBar[];
  settings: Record<string, Record<string, unknown>>;
  off_order: string[];
  table: Record<string, Record<string, unknown>>;
  about: { name: string; desc: string; pre: string[]; post: string[] };
  offers: Offer[];
  undo: string;
  redo: string;
  unsaved: string[];
}
/**
 * A port, or a variable alone if `port` is empty, and whether another port can be connected to it.
 */
export interface Fit {
  task: string;
  port: string;
  variable: string;
  fits: boolean;
  reason: string;
}
/** What saving does to one file. */
export interface FileChange {
  file: string;
  kind: "new" | "changed" | "removed";
  diff: string;
  notes: string[];
}
/** What a run in virtual time gave. */
export interface SimulatedRun {
  ok: boolean;
  problems: string[];
  output: string;
  tasks: Record<string, unknown>[];
  series: Record<string, { t: number[]; v: (number | null)[][] }>;
}
/** A module as `library` gives it. */
export interface LibraryModule {
  name: string;
  doc: string;
  module_class: string;
  rmods: string[];
  ports: { name: string; kind: string; shape: (number | string)[]; unit: string; doc: string }[];
}
/** The load of one RTPU, as the analysis of the job finds it. */
export interface TimingBar {
  rtpu: string;
  scheduler: string;
  utilization: number | null;
  bound: number | null;
  outlook: string;
  text: string;
  late: string[];
  unknown: string[];
  tasks: {
    task: string;
    utilization: number | null;
    maxc: number | null;
    source: string;
    guaranteed: boolean;
  }[];
}
/** Where a program of jobs is. */
export interface RunningProgram {
  kind: "program";
  program: string;
  state: {
    name: string;
    phase: string;
    line: number;
    step: string;
    job: string;
    waiting: string;
    safe: boolean;
    pausing: boolean;
    since: number;
    count: number;
    entered: string[];
    failed: number;
    errors: string[];
    text: string;
  };
}
export type Message =
  | Hello
  | { kind: "graph"; graph: Graph }
  | {
      kind: "history";
      values: Record<string, { t: number[]; v: (number | null)[][] }>;
      events?: PbonetEvent[];
      anew?: boolean;
    }
  | StatusMessage
  | { kind: "values"; t: number; values: Record<string, Value> }
  | { kind: "events"; events: PbonetEvent[] }
  | { kind: "editor"; state: EditorState }
  | RunningProgram
  | { kind: "complaints"; texts: string[] }
  | Answer
  | { kind: "progress"; id: number; text: string; seconds: number }
  | { kind: "at"; t: number; speed: number }
  | { kind: "refused"; text: string };

/** What `swap` and `switch` give: the steps from one configuration to another. */
export interface Transition {
  stays: string[];
  spawns: Record<string, string>;
  items: [string, string][];
  kills: string[];
  replaces: Record<string, string[]>;
  conditions: string[];
  states: Record<string, string>;
}
/** One parameter as `get` and `set` give it. */
export interface ParamValue {
  name: string;
  value: unknown;
  type: string;
  unit: string;
  doc: string;
  bounds: string;
}
/** One task as `profile` gives it. */
export interface TaskProfile {
  task: string;
  counted: number;
  least: number | null;
  most: number | null;
  quantiles: Record<string, number | null>;
  delays: Record<string, number | null>;
  declared: Record<string, number | null>;
  psi: [number, number][];
}
