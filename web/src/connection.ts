// The WebSocket to the server: it reconnects, and every command gets one answer.
import { live } from "./live_state";
import type { Answer, Message } from "./protocol";

const RETRY = 500; // ms
const QUIET = 1500; // ms without any message, after which the page asks whether the server is there
const SILENCE = 5000; // ms after which the connection counts as lost
const EVERY = 10; // attempts after which it is asked why none succeeds
const MOST_WATCHED = 200;

export interface Sent {
  id: number;
  text: string;
  at: number;
  outcome: "running" | "done" | "refused" | "unknown";
  answer: string;
  warnings: string[];
  seconds: number;
}

/** What the page sent, the newest last; the list is replaced with each change. */
let sent: Sent[] = [];
let socket: WebSocket | null = null;
let lastId = 0;
let heardAt = 0;
const waiting = new Map<number, (answer: Answer) => void>();
const wanted = new Map<string, readonly string[]>();
let watched = "";
let attempts = 0;

export const sentCommands = (): readonly Sent[] => sent;

export function connect(): void {
  const url = new URL("ws", location.href);
  url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  url.search = "";
  url.hash = "";
  const mine = new WebSocket(url);
  socket = mine;
  heardAt = performance.now();
  mine.onmessage = (event) => {
    if (socket === mine) take(String(event.data));
  };
  mine.onclose = (event) => {
    if (socket === mine) lose(event.reason);
  };
}

function take(data: string): void {
  heardAt = performance.now();
  const message = JSON.parse(data) as Message;
  if (message.kind === "answer") return answered(message);
  if (message.kind === "progress")
    return change(message.id, { seconds: message.seconds, answer: message.text });
  live.take(message);
  if (message.kind === "hello") {
    attempts = 0;
    sendWatch(true);
  }
}

function lose(reason: string): void {
  socket = null;
  for (const id of [...waiting.keys()]) {
    answered(
      {
        kind: "answer",
        id,
        ok: false,
        warnings: [],
        data: null,
        text: "the connection was lost before the answer came: whether it was done is unknown",
      },
      "unknown",
    );
  }
  live.setLink(live.hello ? "lost" : "connecting", reason);
  setTimeout(connect, RETRY);
  if (++attempts % EVERY === 2) void askWhy();
}

/** Asks for the page itself, as a browser does not say why a socket was refused. */
async function askWhy(): Promise<void> {
  try {
    const answer = await fetch(new URL(".", location.href), { cache: "no-store" });
    if (answer.status === 401 && live.link !== "live")
      live.setLink(
        live.link,
        "This page's link holds no more: open a new one that “pbonet web” has printed.",
      );
  } catch {
    /* the server is not there, as is shown already */
  }
}

/**
 * Notices a server that says nothing more. It answers each `watch`, so that quiet is no silence.
 */
export function watchForSilence(): void {
  setInterval(() => {
    if (live.link !== "live") return;
    const quiet = performance.now() - heardAt;
    if (quiet > SILENCE) {
      const silent = socket;
      lose("The server is silent.");
      silent?.close();
    } else if (quiet > QUIET) sendWatch(true);
  }, 500);
}

function change(id: number, news: Partial<Sent>): void {
  sent = sent.map((one) => (one.id === id ? { ...one, ...news } : one));
  live.tell("sent");
}

function answered(answer: Answer, outcome: Sent["outcome"] = answer.ok ? "done" : "refused"): void {
  change(answer.id, { outcome, answer: answer.text, warnings: answer.warnings });
  waiting.get(answer.id)?.(answer);
  waiting.delete(answer.id);
}

function request(text: string, message: Record<string, unknown>, quiet = false): Promise<Answer> {
  const id = ++lastId;
  if (!quiet)
    sent = [
      ...sent.slice(-499),
      { id, text, at: live.now(), outcome: "running", answer: "", warnings: [], seconds: 0 },
    ];
  live.tell("sent");
  return new Promise((resolve) => {
    waiting.set(id, resolve);
    if (socket?.readyState === WebSocket.OPEN && live.link === "live") {
      socket.send(JSON.stringify({ ...message, id }));
      return;
    }
    answered({
      kind: "answer",
      id,
      ok: false,
      warnings: [],
      data: null,
      text: "there is no connection to the server: nothing was sent",
    });
  });
}

export type Args = Record<string, string | string[]>;

/** Gives a command of the table; its refusal is an answer, too. */
export function command(name: string, args: Args): Promise<Answer> {
  return request(asLine(name, args), { do: "command", command: name, args });
}
/** Gives one that only reads, for the page itself; it is not listed. */
export function readingCommand(name: string, args: Args): Promise<Answer> {
  return request(asLine(name, args), { do: "command", command: name, args }, true);
}
export function line(text: string): Promise<Answer> {
  return request(text, { do: "line", line: text });
}
/** Changes the job that is edited, or asks something about it. */
export function edit(name: string, args: Record<string, unknown> = {}): Promise<Answer> {
  return request(`edit ${name}`, { do: "edit", edit: name, args }, true);
}
/** Does something with a program of jobs. */
export function program(name: string, args: Record<string, unknown> = {}): Promise<Answer> {
  return request(`program ${name}`, { do: "program", program: name, args }, true);
}
export function stop(): Promise<Answer> {
  return request("stop", { do: "stop" });
}

/** Returns a command as it would be typed. */
export function asLine(name: string, args: Args): string {
  const options = new Set(
    live.hello?.commands
      .find((one) => one.name === name)
      ?.args.filter((one) => one.use === "named")
      .map((one) => one.name),
  );
  const words = Object.entries(args).flatMap(([key, value]) =>
    options.has(key) ? [`${key}=${[value].flat().join(",")}`] : [value].flat(),
  );
  return [name, ...words].join(" ");
}

/** Moves to a place of a recorded run. */
export function seek(t: number): void {
  socket?.send(JSON.stringify({ do: "seek", t }));
}
export function play(speed: number): void {
  socket?.send(JSON.stringify({ do: "play", speed }));
}

/**
 * Says which variables one part of the page shows; the first parts named go first where it is too
 * many.
 */
export function want(
  part: "plots" | "trigger" | "inspect" | "list" | "graph",
  names: readonly string[],
): void {
  wanted.set(part, names);
  sendWatch();
}

export function allWanted(
  parts: ReadonlyMap<string, readonly string[]>,
  most = MOST_WATCHED,
): string[] {
  const names = new Set<string>();
  for (const part of ["trigger", "plots", "inspect", "list", "graph"])
    for (const name of parts.get(part) ?? []) names.add(name);
  return [...names].slice(0, most);
}

function sendWatch(anyway = false): void {
  const variables = allWanted(wanted).sort();
  const text = variables.join("\n");
  if (
    (text === watched && !anyway) ||
    socket?.readyState !== WebSocket.OPEN ||
    live.link !== "live"
  )
    return;
  watched = text;
  socket.send(JSON.stringify({ do: "watch", variables }));
}
