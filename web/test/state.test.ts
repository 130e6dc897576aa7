import assert from "node:assert/strict";
import { test } from "node:test";
import { complete } from "../src/completion";
import { LiveState, illegalCauses, mergeEvents, mergeStatus } from "../src/live_state";
import type { Command, PbonetEvent, RtpuStatus, StatusMessage, TaskStatus } from "../src/protocol";

const status = (task: string, state: TaskStatus["state"] = "ON"): TaskStatus => ({
  task,
  rtpu: "arm0",
  state,
  signals: [],
  fields: {},
  error: "",
  warning: "",
  waits: "",
  standby: false,
  fallback_of: "",
  restarted: "",
});
const rtpu = (name: string, illegal: string[] = []): RtpuStatus => ({
  rtpu: name,
  backend: "",
  scheduler: "MUF",
  util: 0,
  dispatcher: 0,
  illegal,
  silent: false,
  stalls: 0,
  load: 0,
});
const message = (more: Partial<StatusMessage>): StatusMessage => ({
  kind: "status",
  t: 1,
  whole: false,
  rtpus: [],
  tasks: [],
  gone: [],
  ...more,
});
const event = (n: number): PbonetEvent => ({
  n,
  t: n,
  task: "",
  rtpu: "",
  severity: "info",
  code: "X",
  text: "",
});

test("a difference changes only what it names", () => {
  const tasks = new Map([
    ["a", status("a")],
    ["b", status("b")],
    ["c", status("c")],
  ]);
  const changed = mergeStatus(
    tasks,
    new Map(),
    message({ tasks: [status("a", "OFF")], gone: ["c"] }),
  );
  assert.deepEqual(
    [...tasks].map(([name, one]) => [name, one.state]),
    [
      ["a", "OFF"],
      ["b", "ON"],
    ],
  );
  assert.deepEqual(changed.sort(), ["task:a", "task:c"]);
});

test("a whole status removes what it does not name", () => {
  const tasks = new Map([
    ["a", status("a")],
    ["b", status("b")],
  ]);
  const rtpus = new Map([
    ["arm0", rtpu("arm0")],
    ["arm1", rtpu("arm1")],
  ]);
  mergeStatus(tasks, rtpus, message({ whole: true, tasks: [status("b")], rtpus: [rtpu("arm0")] }));
  assert.deepEqual([[...tasks.keys()], [...rtpus.keys()]], [["b"], ["arm0"]]);
});

test("events are kept once each, in order, and the newest of them", () => {
  const known = [event(1), event(2), event(3)];
  assert.deepEqual(
    mergeEvents(known, [event(2), event(4)]).map((one) => one.n),
    [1, 2, 3, 4],
  );
  assert.deepEqual(
    mergeEvents(known, [event(4), event(5)], 3).map((one) => one.n),
    [3, 4, 5],
  );
  assert.equal(mergeEvents(known, []), known);
});

test("each cause of the flag is named once, with its RTPUs", () => {
  assert.deepEqual(
    illegalCauses([rtpu("arm0", ["T has no writer"]), rtpu("arm1", ["T has no writer"])]),
    [{ cause: "T has no writer", rtpus: ["arm0", "arm1"] }],
  );
});

const arg = (name: string, kind: string, use = "one") => ({
  name,
  kind,
  doc: "",
  use,
  last: false,
});
const commands: Command[] = [
  {
    name: "on",
    usage: "",
    help: "",
    changes: true,
    examples: [],
    args: [arg("task", "task", "any"), arg("text", "word", "named")],
  },
  {
    name: "set",
    usage: "",
    help: "",
    changes: true,
    examples: [],
    args: [
      arg("task", "task", "maybe"),
      arg("param", "parameter", "maybe"),
      arg("value", "word", "any"),
    ],
  },
  {
    name: "swap",
    usage: "",
    help: "",
    changes: true,
    examples: [],
    args: [arg("old", "task"), arg("new", "rmod"), arg("dry_run", "yes", "named")],
  },
  {
    name: "status",
    usage: "",
    help: "",
    changes: false,
    examples: [],
    args: [arg("task", "task", "any")],
  },
  {
    name: "status set",
    usage: "",
    help: "",
    changes: false,
    examples: [],
    args: [arg("field", "field", "any")],
  },
];
const names = {
  task: ["pid", "grav"],
  rmod: ["pid2"],
  field: ["cycle"],
  "parameter pid": ["kp", "kd"],
};

test("a command line is completed from the table and the names", () => {
  assert.deepEqual(complete("s", commands, names), ["set", "status", "swap"]);
  assert.deepEqual(complete("on p", commands, names), ["pid"]);
  assert.deepEqual(complete("on pid g", commands, names), ["grav"]);
  assert.deepEqual(complete("set pid k", commands, names), ["kd", "kp"]);
  assert.deepEqual(complete("swap pid ", commands, names), ["dry_run=", "pid2"]);
  assert.deepEqual(complete("swap pid pid2 dry_run=", commands, names), [
    "dry_run=no",
    "dry_run=yes",
  ]);
  assert.deepEqual(complete("status ", commands, names), ["grav", "pid", "set"]);
  assert.deepEqual(complete("status set c", commands, names), ["cycle"]);
  assert.deepEqual(complete("nothing x", commands, names), []);
});

test("another time of a recorded run has none of the values that were shown before", () => {
  const live = new LiveState();
  const value = { t: 5, v: [1], writer: "", age: 0, stale: false };
  live.take({ kind: "values", t: 5, values: { Q: value } });
  let told = 0;
  live.subscribe("value:Q", () => (told += 1));
  live.take({ kind: "history", values: {}, events: [], anew: true });
  assert.equal(live.values.has("Q"), false);
  assert.equal(live.rings.has("Q"), false);
  assert.ok(told > 0);
});
