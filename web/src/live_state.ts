// All that the server told last, outside of React: parts of the page subscribe to what they show.
import { useCallback, useSyncExternalStore } from "react";
import type {
  EditorState,
  FieldInfo,
  Graph,
  Hello,
  LogInfo,
  Message,
  PbonetEvent,
  Role,
  RtpuStatus,
  RunningProgram,
  State,
  StatusMessage,
  TaskStatus,
  Value,
  Variable,
} from "./protocol";
import { Ring } from "./ring";

export const MOST_EVENTS = 5000;
const SHOW_PERIOD = 250; // ms between two drawings of a value as text

/** Puts a status into the maps of tasks and RTPUs; returns the keys of what changed. */
export function mergeStatus(
  tasks: Map<string, TaskStatus>,
  rtpus: Map<string, RtpuStatus>,
  status: StatusMessage,
): string[] {
  const changed: string[] = [];
  if (status.whole) {
    const there = new Set(status.tasks.map((one) => one.task));
    for (const name of [...tasks.keys()])
      if (!there.has(name)) {
        tasks.delete(name);
        changed.push(`task:${name}`);
      }
    const rtpusThere = new Set(status.rtpus.map((one) => one.rtpu));
    for (const name of [...rtpus.keys()])
      if (!rtpusThere.has(name)) {
        rtpus.delete(name);
        changed.push(`rtpu:${name}`);
      }
  }
  for (const name of status.gone) if (tasks.delete(name)) changed.push(`task:${name}`);
  for (const one of status.tasks) {
    tasks.set(one.task, one);
    changed.push(`task:${one.task}`);
  }
  for (const one of status.rtpus) {
    rtpus.set(one.rtpu, one);
    changed.push(`rtpu:${one.rtpu}`);
  }
  return changed;
}

/** Returns the events with new ones put in by number, each once, the newest `most` of them. */
export function mergeEvents(
  known: readonly PbonetEvent[],
  more: readonly PbonetEvent[],
  most = MOST_EVENTS,
): PbonetEvent[] {
  const last = known.at(-1);
  const first = more[0];
  if (!first) return known as PbonetEvent[];
  if (!last || last.n < first.n) return [...known, ...more].slice(-most);
  const byNumber = new Map(known.map((one) => [one.n, one]));
  for (const one of more) byNumber.set(one.n, one);
  return [...byNumber.values()].sort((a, b) => a.n - b.n).slice(-most);
}

/** Returns the causes of the illegal-configuration flag, each with the RTPUs that show it. */
export function illegalCauses(rtpus: Iterable<RtpuStatus>): { cause: string; rtpus: string[] }[] {
  const found = new Map<string, string[]>();
  for (const one of rtpus)
    for (const cause of one.illegal) found.set(cause, [...(found.get(cause) ?? []), one.rtpu]);
  return [...found].map(([cause, names]) => ({ cause, rtpus: names }));
}

/** State outside of React: parts of the page subscribe to keys of it. */
export class Keyed {
  /** Grows with each change of a key, so that React sees that there was one. */
  private versions = new Map<string, number>();
  private listeners = new Map<string, Set<() => void>>();

  subscribe(key: string, changed: () => void): () => void {
    let set = this.listeners.get(key);
    if (!set) this.listeners.set(key, (set = new Set()));
    set.add(changed);
    return () => {
      set.delete(changed);
      if (!set.size && this.listeners.get(key) === set) this.listeners.delete(key);
    };
  }

  version(key: string): number {
    return this.versions.get(key) ?? 0;
  }

  tell(...keys: string[]): void {
    for (const key of keys) {
      this.versions.set(key, this.version(key) + 1);
      for (const changed of [...(this.listeners.get(key) ?? [])]) changed();
    }
  }
}

/** Draws the component again when something of this key changes; returns its version. */
export function useKey(of: Keyed, key: string): number {
  const subscribe = useCallback((changed: () => void) => of.subscribe(key, changed), [of, key]);
  return useSyncExternalStore(subscribe, () => of.version(key));
}

export type Link = "connecting" | "live" | "lost";

export class LiveState extends Keyed {
  hello: Hello | null = null;
  graph: Graph | null = null;
  variables = new Map<string, Variable>();
  tasks = new Map<string, TaskStatus>();
  rtpus = new Map<string, RtpuStatus>();
  values = new Map<string, Value>();
  rings = new Map<string, Ring>();
  /** The job that is edited; null before it was opened. */
  editor: EditorState | null = null;
  /** The program of jobs that runs, or ran last. */
  running: RunningProgram | null = null;
  events: PbonetEvent[] = [];
  complaints: string[] = [];
  /** How fast a recorded run goes on; 0: it stands still. */
  speed = 0;
  link: Link = "connecting";
  /** Why the last connection ended; empty if the server did not say. */
  linkText = "";
  /** The server's time of the newest message, and when it came by this page's clock (ms). */
  private heard = { t: 0, at: 0 };
  private sampleListeners = new Set<
    (name: string, t: number, v: readonly (number | null)[]) => void
  >();
  private toShow = new Set<string>();
  private timer: ReturnType<typeof setTimeout> | null = null;

  get role(): Role | null {
    return this.hello?.role ?? null;
  }
  get log(): LogInfo | null {
    return this.hello?.log ?? null;
  }
  /** Whether this page may steer: an observer may not, and a recorded run cannot be steered. */
  get steers(): boolean {
    return this.role === "operator" && !this.log;
  }
  get fields(): FieldInfo[] {
    return this.hello?.fields ?? [];
  }

  /** The time of the subsystem now: by its server, or the place in a recorded run. */
  now(): number {
    if (!this.heard.at) return 0;
    return this.link === "live" && !this.log
      ? this.heard.t + (performance.now() - this.heard.at) / 1000
      : this.heard.t;
  }

  /** Calls with every sample of every watched variable as it comes. */
  onSample(heard: (name: string, t: number, v: readonly (number | null)[]) => void): () => void {
    this.sampleListeners.add(heard);
    return () => void this.sampleListeners.delete(heard);
  }

  setLink(link: Link, text = ""): void {
    this.link = link;
    this.linkText = text;
    this.tell("link");
  }

  take(message: Message): void {
    switch (message.kind) {
      case "hello":
        return this.takeHello(message);
      case "graph":
        return this.takeGraph(message.graph);
      case "history":
        return this.takeHistory(message);
      case "at":
        this.hear(message.t);
        this.speed = message.speed;
        return this.tell("at");
      case "status":
        this.hear(message.t);
        this.tell(...mergeStatus(this.tasks, this.rtpus, message), "status");
        return;
      case "values":
        this.hear(message.t);
        return this.takeValues(message.values);
      case "events":
        this.events = mergeEvents(this.events, message.events);
        return this.tell("events");
      case "editor":
        this.editor = message.state;
        return this.tell("editor");
      case "program":
        this.running = message;
        return this.tell("program");
      case "complaints":
        this.complaints = message.texts;
        return this.tell("complaints");
      case "refused":
        this.complaints = [...this.complaints, message.text];
        return this.tell("complaints");
    }
  }

  private hear(t: number): void {
    this.heard = { t, at: performance.now() };
  }

  private takeHello(hello: Hello): void {
    this.hello = hello;
    this.events = [];
    this.complaints = [];
    this.tasks.clear();
    this.rtpus.clear();
    this.hear(hello.log ? hello.log.begin : hello.now);
    document.title = `${hello.name} – pbonet`;
    this.setLink("live");
    this.tell("hello", "events", "complaints", "status");
  }

  private takeGraph(graph: Graph): void {
    this.graph = graph;
    this.variables = new Map(graph.variables.map((one) => [one.name, one]));
    for (const [name, ring] of this.rings)
      if (this.variables.get(name)?.n !== ring.width) this.rings.delete(name);
    this.tell("graph");
  }

  private takeHistory({ values, events, anew }: Extract<Message, { kind: "history" }>): void {
    if (anew) {
      // What was shown of another time is not of this one.
      const old = [...this.values.keys()].map((name) => `value:${name}`);
      this.values.clear();
      this.rings.clear();
      this.tell(...old);
    }
    for (const [name, { t, v }] of Object.entries(values))
      if (v[0]) this.ring(name, v[0].length).putHistory(t, v);
    if (events?.length) this.events = this.log ? events : mergeEvents(this.events, events);
    this.tell("samples", "events");
  }

  private takeValues(values: Record<string, Value>): void {
    for (const [name, value] of Object.entries(values)) {
      this.values.set(name, value);
      const t = value.t;
      if (t !== null && this.ring(name, value.v.length).push(t, value.v))
        this.sampleListeners.forEach((heard) => heard(name, t, value.v));
      this.toShow.add(`value:${name}`);
    }
    this.tell("samples");
    this.timer ??= setTimeout(() => {
      this.timer = null;
      const keys = [...this.toShow];
      this.toShow.clear();
      this.tell(...keys);
    }, SHOW_PERIOD);
  }

  private ring(name: string, width: number): Ring {
    let ring = this.rings.get(name);
    if (!ring || ring.width !== width) this.rings.set(name, (ring = new Ring(width)));
    return ring;
  }
}

export const live = new LiveState();

export const useLive = (key: string): number => useKey(live, key);

/** Draws again only when the variable becomes stale, or is so no more. */
export function useStale(name: string): boolean {
  const subscribe = useCallback(
    (changed: () => void) => live.subscribe(`value:${name}`, changed),
    [name],
  );
  return useSyncExternalStore(subscribe, () => live.values.get(name)?.stale ?? false);
}
/** The state to show: a task of the graph without a status does not exist. */
export function stateOf(name: string): State | "?" {
  return live.tasks.get(name)?.state ?? (live.rtpus.size ? "NOT-CREATED" : "?");
}
export function useTask(name: string): TaskStatus | undefined {
  useLive(`task:${name}`);
  return live.tasks.get(name);
}
export function useRtpu(name: string): RtpuStatus | undefined {
  useLive(`rtpu:${name}`);
  return live.rtpus.get(name);
}
export function useValue(name: string): Value | undefined {
  useLive(`value:${name}`);
  return live.values.get(name);
}
export function useGraph(): Graph | null {
  useLive("graph");
  return live.graph;
}
