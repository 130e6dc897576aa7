import assert from "node:assert/strict";
import { test } from "node:test";
import {
  barOf,
  diffLines,
  doneElsewhere,
  faultHead,
  faultsOf,
  groupModules,
  jobName,
  misfit,
  newTasks,
  numbersOf,
} from "../src/assemble_words";
import { drawing, layoutLoaded } from "../src/graph_layout";
import type {
  EditorState,
  Fault,
  Fit,
  Graph,
  LibraryModule,
  Offer,
  Port,
  TaskInfo,
  TimingBar,
} from "../src/protocol";

const port = (name: string): Port => ({
  port: name,
  variable: name,
  constant: false,
  unit: "rad",
  shape: [6],
  type: "double",
});
const task = (name: string, rtpu: string, ins: string[], outs: string[]): TaskInfo => ({
  name,
  module: name,
  class: "",
  desc: "",
  rtpu,
  freq: 100,
  type: "periodic",
  crit: "",
  fallback_of: "",
  parts: [],
  devices: [],
  ins: ins.map(port),
  outs: outs.map(port),
  params: [],
  rmod_file: "",
});
const graph = (...tasks: TaskInfo[]): Graph => ({
  name: "arm",
  job: "one",
  rtpus: [
    { name: "arm0", scheduler: "MUF", keeper: true },
    { name: "arm1", scheduler: "MUF", keeper: false },
  ],
  tasks,
  variables: [],
  wires: [],
  links: [],
  faults: [],
});

await layoutLoaded;

test("a fault is said in one sentence, without its place and what was expected", () => {
  assert.equal(
    faultHead(
      "/a b.rmod:9:1: one and two both write X (expected one task (equation 1), got 2: /a:9:1); turn one off",
    ),
    "/a b.rmod:9:1: one and two both write X",
  );
  assert.equal(
    faultHead(
      "/a/b.rmod:9:1: one and two both write X (expected one task (equation 1), got 2: /a:9:1); turn one off",
    ),
    "one and two both write X",
  );
  assert.equal(faultHead("/a/b.rmod: it cannot be read; correct it"), "it cannot be read");
  assert.equal(
    faultHead("on RTPU arm1 trace (slow) may miss deadlines"),
    "on RTPU arm1 trace (slow) may miss deadlines",
  );
});

test("faults that prevent a start come first, each with its offers", () => {
  const fault = (text: string, severity: Fault["severity"]): Fault => ({
    text,
    severity,
    tasks: [],
    variables: [],
    ports: [],
    remedy: "",
  });
  const offer = (text: string, ...faults: number[]): Offer => ({
    faults,
    kind: "join",
    text,
    steps: [],
  });
  const state = {
    graph: { ...graph(), faults: [fault("late", "warn"), fault("two writers", "refuse")] },
    offers: [offer("join", 1), offer("both", 0, 1)],
  } as unknown as EditorState;
  assert.deepEqual(
    faultsOf(state).map(({ number, fault: { text }, offers }) => [
      number,
      text,
      offers.map((one) => one.text),
    ]),
    [
      [1, "two writers", ["join", "both"]],
      [0, "late", ["both"]],
    ],
  );
});

test("modules are grouped by class, by the names of what can be added", () => {
  const module = (name: string, module_class: string, ...rmods: string[]): LibraryModule => ({
    name,
    doc: "",
    module_class,
    rmods,
    ports: [],
  });
  const groups = groupModules([
    module("pid", "controller", "b/pid_six.rmod", "pid"),
    module("diff", "signal", "qrdiff", "qmdiff", "qrdiff"),
    module("bare", "controller"),
  ]);
  assert.deepEqual(
    groups.map(([name, found]) => [name, found.map((one) => one.rmod)]),
    [
      ["controller", ["bare", "pid", "pid_six"]],
      ["signal", ["qmdiff", "qrdiff"]],
    ],
  );
});

test("only ports that fit can be connected, and others say why", () => {
  const both = graph(
    task("pid", "arm0", ["Q_REF", "T"], ["Q_MEZ"]),
    task("trace", "arm1", [], ["Q_REF"]),
    task("grav", "arm1", ["Q"], ["T"]),
  );
  const fits: Fit[] = [
    { task: "pid", port: "Q_REF", variable: "Q_REF", fits: true, reason: "" },
    { task: "pid", port: "T", variable: "T", fits: false, reason: "units differ: rad and N*m" },
  ];
  const from = { task: "trace", port: "Q_REF", fits };
  assert.equal(misfit(both, from, "pid", "Q_REF"), "");
  assert.equal(misfit(both, from, "pid", "T"), "units differ: rad and N*m");
  assert.equal(misfit(both, from, "grav", "T"), "both are outputs");
  assert.equal(
    misfit({ ...both }, { task: "pid", port: "T", fits: [] }, "grav", "Q"),
    "both are inputs",
  );
  assert.equal(misfit(both, from, "trace", "Q_REF"), "");
  assert.equal(
    misfit(both, { task: "pid", port: "Q_REF", fits: [] }, "pid", "Q_MEZ"),
    "it is of pid, too",
  );
});

test("what was added is found, and files are named shortly", () => {
  assert.deepEqual(
    newTasks(
      graph(task("a", "arm0", [], [])),
      graph(task("a", "arm0", [], []), task("b", "arm0", [], [])),
    ),
    ["b"],
  );
  assert.deepEqual(newTasks(null, graph(task("a", "arm0", [], []))), ["a"]);
  assert.equal(jobName("/x/y/puma.job"), "puma");
});

test("a bar shows the load against the bound, also beyond it", () => {
  const bar = (utilization: number | null, bound: number | null) =>
    barOf({ utilization, bound } as TimingBar);
  assert.deepEqual(bar(0.4, 0.95), { filled: 40, bound: 95, over: false });
  assert.deepEqual(bar(1.25, 1), { filled: 100, bound: 80, over: true });
  assert.deepEqual(bar(null, null), { filled: 0, bound: 100, over: false });
});

test("lines of a diff are told apart", () => {
  const diff = "--- a/x.job\n+++ b/x.job\n@@ -1,2 +1,2 @@\n JOB x\n-TASK a\n+TASK b\n";
  assert.deepEqual(
    diffLines(diff).map((one) => [one.kind, one.text]),
    [
      ["place", "@@ -1,2 +1,2 @@"],
      ["same", " JOB x"],
      ["removed", "-TASK a"],
      ["added", "+TASK b"],
    ],
  );
});

test("lists of numbers are read, and what is none is said", () => {
  assert.deepEqual(numbersOf(" 1, 2.5\n-3e2 "), [1, 2.5, -300]);
  assert.equal(numbersOf("  "), null);
  assert.throws(() => numbersOf("1 two"), /two is no number/);
});

test("an RTPU without a task is drawn where a module can be dropped, and apart from others", () => {
  const one = graph(task("a", "arm1", [], []));
  const shown = (empty: boolean) =>
    drawing(one, { compact: false, folded: new Set(), operator: false, empty }).nodes.filter(
      (node) => node.type === "frame",
    );
  assert.deepEqual(
    shown(false).map((node) => node.id),
    ["rtpu arm1"],
  );
  const [first, second] = shown(true);
  assert.equal(first!.id, "rtpu arm0");
  assert.ok(
    first!.position.y + first!.height! <= second!.position.y ||
      second!.position.y + second!.height! <= first!.position.y,
  );
});

test("what another browser did to the job is said", () => {
  const state = (more: Partial<EditorState>): EditorState =>
    ({ file: "/x/a.job", graph: {}, undo: "", redo: "", unsaved: [], ...more }) as EditorState;
  const edited = state({ undo: "add qrdiff", unsaved: ["/x/a.job"] });
  assert.equal(doneElsewhere(state({}), edited), "changed the job: add qrdiff");
  assert.equal(doneElsewhere(edited, state({ redo: "add qrdiff" })), "took back: add qrdiff");
  assert.equal(doneElsewhere(edited, state({ undo: "add qrdiff" })), "saved the job");
  assert.equal(
    doneElsewhere(edited, state({ file: "/x/b.job" })),
    "opened b instead of a, without saving a.job",
  );
  assert.equal(doneElsewhere(edited, edited), "");
});
