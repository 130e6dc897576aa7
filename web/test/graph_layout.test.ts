import assert from "node:assert/strict";
import { test } from "node:test";
import {
  drawing,
  keepEqual,
  layoutLoaded,
  faultyPorts,
  outHandle,
  shiftInto,
  wirePath,
} from "../src/graph_layout";
import type { Graph, Port, TaskInfo } from "../src/protocol";

const port = (variable: string, constant = false): Port => ({
  port: variable,
  variable,
  constant,
  unit: "rad",
  shape: [6],
  type: "double",
});
function task(
  name: string,
  rtpu: string,
  ins: string[],
  outs: string[],
  more: Partial<TaskInfo> = {},
): TaskInfo {
  return {
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
    ins: ins.map((one) => port(one)),
    outs: outs.map((one) => port(one)),
    params: [],
    rmod_file: "",
    ...more,
  };
}
function puma(): Graph {
  return {
    name: "puma",
    job: "teleop",
    rtpus: [
      { name: "arm0", scheduler: "MUF", keeper: true },
      { name: "arm1", scheduler: "MUF", keeper: false },
    ],
    tasks: [
      task("pid", "arm0", ["Q_REF", "T"], ["Q_MEZ"]),
      task("grav", "arm1", ["Q_MEZ"], ["T"]),
      task("trace", "arm1", [], ["Q_REF"]),
    ],
    variables: [],
    links: [],
    faults: [],
    wires: [
      { variable: "Q_REF", from: "trace", to: "pid", constant: false },
      { variable: "Q_MEZ", from: "pid", to: "grav", constant: false },
      { variable: "T", from: "grav", to: "pid", constant: false },
      { variable: "NDOF", from: "pid", to: "grav", constant: true },
    ],
  };
}
const plain = { compact: false, folded: new Set<string>(), operator: true };
const frames = (made: ReturnType<typeof drawing>) =>
  made.nodes.filter((one) => one.type === "frame");

await layoutLoaded;

test("one card per task, within a frame per RTPU", () => {
  const made = drawing(puma(), plain);
  assert.deepEqual(
    made.nodes.filter((one) => one.type === "task").map((one) => one.id),
    ["task pid", "task grav", "task trace"],
  );
  assert.deepEqual(
    frames(made).map((one) => one.id),
    ["rtpu arm0", "rtpu arm1"],
  );
  for (const node of made.nodes) {
    if (node.type !== "task") continue;
    const frame = made.nodes.find((one) => one.id === `rtpu ${node.data.task.rtpu}`)!;
    assert.ok(
      node.position.x > frame.position.x &&
        node.position.x + node.width! < frame.position.x + frame.width!,
    );
    assert.ok(
      node.position.y > frame.position.y &&
        node.position.y + node.height! < frame.position.y + frame.height!,
    );
  }
});

test("cards do not overlap, nor do frames one above the other", () => {
  const graph = puma();
  graph.tasks.push(task("other", "arm2", [], []), task("more", "arm3", [], []));
  const { nodes } = drawing(graph, plain);
  for (const kind of ["task", "frame"]) apart(nodes.filter((one) => one.type === kind));
});

function apart(cards: ReturnType<typeof drawing>["nodes"]): void {
  for (const a of cards)
    for (const b of cards) {
      if (a === b) continue;
      const isApart =
        a.position.x + a.width! <= b.position.x ||
        b.position.x + b.width! <= a.position.x ||
        a.position.y + a.height! <= b.position.y ||
        b.position.y + b.height! <= a.position.y;
      assert.ok(isApart, `${a.id} and ${b.id} overlap`);
    }
}

test("each wire is an edge between its ports; constants are told apart", () => {
  const made = drawing(puma(), plain);
  const wire = made.edges.find((one) => one.data!.variables[0] === "Q_REF")!;
  assert.deepEqual(
    [wire.source, wire.sourceHandle, wire.target, wire.targetHandle],
    ["task trace", outHandle("Q_REF"), "task pid", "in:Q_REF"],
  );
  assert.deepEqual(made.edges.map((one) => one.data!.kind).sort(), [
    "constant",
    "variable",
    "variable",
    "variable",
  ]);
});

test("a wire that leads back runs below the cards that it passes", () => {
  const made = drawing(puma(), plain);
  const back = made.edges.filter((one) => {
    const from = made.nodes.find((node) => node.id === one.source)!,
      to = made.nodes.find((node) => node.id === one.target)!;
    return from.position.x + from.width! > to.position.x;
  });
  assert.ok(back.length > 0);
  for (const one of back) {
    const y = one.data!.points[0]![1];
    for (const id of [one.source, one.target]) {
      const node = made.nodes.find((each) => each.id === id)!;
      assert.ok(y > node.position.y + node.height!);
    }
  }
  assert.equal(
    new Set(back.map((one) => one.data!.points[0]![1])).size,
    back.length,
    "two share a lane",
  );
});

test("one wire of each variable has its label", () => {
  const graph = puma();
  graph.wires.push({ variable: "Q_MEZ", from: "pid", to: "trace", constant: false });
  const labelled = drawing(graph, plain).edges.filter(
    (one) => one.data!.variables[0] === "Q_MEZ" && one.data!.labelled,
  );
  assert.equal(labelled.length, 1);
});

test("a folded RTPU is one card, and wires within it are gone", () => {
  const made = drawing(puma(), { ...plain, folded: new Set(["arm1"]) });
  assert.deepEqual(
    made.nodes.filter((one) => one.type === "task").map((one) => one.id),
    ["task pid"],
  );
  assert.deepEqual(made.edges.map((one) => `${one.source}>${one.target}`).sort(), [
    "rtpu arm1>task pid",
    "rtpu arm1>task pid",
    "task pid>rtpu arm1",
    "task pid>rtpu arm1",
  ]);
});

test("a compact drawing has one wire for all variables between two tasks", () => {
  const graph = puma();
  graph.wires.push({ variable: "Q^_MEZ", from: "pid", to: "grav", constant: false });
  const found = drawing(graph, { ...plain, compact: true }).edges.filter(
    (one) => one.source === "task pid" && one.data!.kind === "variable",
  );
  assert.deepEqual(
    found.map((one) => one.data!.variables),
    [["Q_MEZ", "Q^_MEZ"]],
  );
});

test("links, devices and fallbacks are drawn", () => {
  const graph = puma();
  graph.links.push({
    name: "seen",
    task: "pid",
    variable: "Q_REF",
    direction: "in",
    from: "vision",
    to: "",
  });
  graph.tasks[0]!.devices = ["bus"];
  graph.tasks[2]!.fallback_of = "grav";
  const made = drawing(graph, plain);
  const told = made.edges.map((one) => `${one.data!.kind}: ${one.source}>${one.target}`);
  assert.ok(told.includes("link: subsystem vision>task pid"));
  assert.ok(told.includes("device: device bus>task pid"));
  assert.ok(told.includes("fallback: task trace>task grav"));
});

test("a fault is at the ports that it names, and at those only", () => {
  const graph = puma();
  graph.faults.push({
    text: "no writer",
    severity: "refuse",
    tasks: ["pid"],
    variables: ["T"],
    ports: [],
    remedy: "",
  });
  assert.deepEqual(
    graph.tasks.map((one) => faultyPorts(graph, one)),
    [["T"], [], []],
  );
});

test("200 tasks and 500 variables are all placed", () => {
  const graph = puma();
  graph.rtpus = Array.from({ length: 8 }, (_, k) => ({
    name: `r${k}`,
    scheduler: "MUF",
    keeper: k === 0,
  }));
  graph.tasks = Array.from({ length: 200 }, (_, k) => task(`t${k}`, `r${k % 8}`, [], [`V${k}`]));
  graph.wires = Array.from({ length: 500 }, (_, k) => ({
    variable: `V${k % 200}`,
    from: `t${k % 200}`,
    to: `t${(k * 7 + 3) % 200}`,
    constant: false,
  }));
  const made = drawing(graph, { ...plain, compact: true });
  assert.equal(made.nodes.filter((one) => one.type === "task").length, 200);
  assert.ok(made.nodes.every((one) => Number.isFinite(one.position.x + one.position.y)));
});

test("paths start and end at their ports", () => {
  for (const points of [
    [],
    [
      [50, 80],
      [-50, 80],
    ],
    [
      [20, 5],
      [60, 9],
    ],
  ] as [number, number][][]) {
    const [path] = wirePath([0, 0], points, [100, 40]);
    assert.match(path, /^M0,0/);
    assert.match(path, /(100,40|H100)$/);
  }
});

test("a message at an edge is moved into the drawing", () => {
  const area = { left: 0, top: 100, right: 1000, bottom: 800 };
  const box = (left: number, top: number, width: number, height: number) => ({
    left,
    top,
    right: left + width,
    bottom: top + height,
  });
  assert.deepEqual(shiftInto(box(300, 300, 330, 90), area), [0, 0]);
  assert.deepEqual(shiftInto(box(900, 760, 330, 90), area), [-238, -58]);
  assert.deepEqual(shiftInto(box(-50, 50, 330, 90), area), [58, 58]);
  assert.deepEqual(
    shiftInto(box(300, 300, 330, 900), area)[1],
    -192,
    "the beginning of a long one is read first",
  );
});

test("what has not changed is the same object in the next drawing", () => {
  const before = drawing(puma(), plain);
  const graph = puma();
  graph.tasks = graph.tasks.map((one, k) => (k === 1 ? { ...one, desc: "another" } : one));
  const after = keepEqual(before, drawing(graph, plain));
  const changed = after.nodes.filter((one) => !before.nodes.includes(one));
  assert.deepEqual(
    changed.map((one) => one.id),
    [`task ${graph.tasks[1]!.name}`],
  );
  assert.ok(after.edges.every((one) => before.edges.includes(one)));
});
