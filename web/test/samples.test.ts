import assert from "node:assert/strict";
import { test } from "node:test";
import { clock, count, number, seconds, stallText } from "../src/format";
import type { Variable } from "../src/protocol";
import { Ring } from "../src/ring";
import { alignSeries, parseSeries, toCsv } from "../src/series";
import { Trigger, triggerWindow } from "../src/trigger";

const variable = (name: string, n: number, unit = "rad"): Variable => ({
  name,
  n,
  unit,
  desc: "",
  type: "double",
  shape: [n],
  constant: false,
  writers: [],
  readers: [],
});
const variables = new Map(
  [variable("Q", 6), variable("X", 1, "none")].map((one) => [one.name, one]),
);

test("a ring keeps the newest samples", () => {
  const ring = new Ring(2, 3);
  for (let t = 1; t <= 5; t++) ring.push(t, [t, -t]);
  assert.equal(ring.length, 3);
  assert.deepEqual(ring.between(1, -Infinity, Infinity), [
    [3, 4, 5],
    [-3, -4, -5],
  ]);
  assert.equal(ring.push(5, [0, 0]), false);
  assert.equal(ring.newest, 5);
});

test("a ring gives what is within a time, and one sample on each side", () => {
  const ring = new Ring(1, 10);
  for (let t = 0; t < 8; t++) ring.push(t, [t === 3 ? null : t]);
  assert.deepEqual(ring.between(0, 2.5, 4.5), [
    [2, 3, 4, 5],
    [2, null, 4, 5],
  ]);
});

test("history comes before the samples that are there, each once", () => {
  const ring = new Ring(1, 10);
  ring.push(3, [30]);
  ring.push(4, [40]);
  ring.putHistory([1, 2, 3], [[10], [20], [30]]);
  assert.deepEqual(ring.between(0, -Infinity, Infinity), [
    [1, 2, 3, 4],
    [10, 20, 30, 40],
  ]);
  ring.putHistory([8, 9], [[80], [90]]); // of a server that was started again
  assert.deepEqual(ring.between(0, -Infinity, Infinity), [
    [1, 2, 3, 4, 8, 9],
    [10, 20, 30, 40, 80, 90],
  ]);
});

test("after a clock was put back samples go on", () => {
  const ring = new Ring(1, 10);
  for (let t = 100; t < 105; t++) ring.push(t, [t]);
  assert.equal(ring.push(103.5, [0]), false); // out of order, but the clock is the same
  assert.equal(ring.push(101.5, [1]), true);
  assert.equal(ring.push(102, [2]), true);
  assert.deepEqual(ring.between(0, -Infinity, Infinity), [
    [100, 101, 101.5, 102],
    [100, 101, 1, 2],
  ]);
  assert.equal(ring.push(3, [3]), true);
  assert.deepEqual(ring.between(0, -Infinity, Infinity), [[3], [3]]);
});

const settings = {
  variable: "Q",
  element: 0,
  level: 1,
  edge: "rising" as const,
  hold: 0,
  once: false,
};
function feed(trigger: Trigger, samples: [number, number][]): (number | null)[] {
  return samples.map(([t, v]) => trigger.feed(t, v));
}

test("a trigger finds the time of the crossing between two samples", () => {
  assert.deepEqual(
    feed(new Trigger(settings), [
      [0, 0],
      [1, 2],
      [2, 3],
      [3, 0],
    ]),
    [null, 0.5, null, null],
  );
  assert.deepEqual(
    feed(new Trigger({ ...settings, edge: "falling" }), [
      [0, 2],
      [1, 0],
    ]),
    [null, 0.5],
  );
});

test("within its hold a trigger ignores crossings, and after one if once", () => {
  const waves: [number, number][] = [
    [0, 0],
    [1, 2],
    [2, 0],
    [3, 2],
    [4, 0],
    [5, 2],
  ];
  assert.deepEqual(
    feed(new Trigger({ ...settings, hold: 3 }), waves).filter((t) => t !== null),
    [0.5, 4.5],
  );
  const once = new Trigger({ ...settings, once: true });
  assert.deepEqual(
    feed(once, waves).filter((t) => t !== null),
    [0.5],
  );
  once.arm();
  assert.deepEqual(
    feed(once, [
      [6, 0],
      [7, 2],
    ]),
    [null, 6.5],
  );
});

test("a trigger goes on after a clock was put back", () => {
  const trigger = new Trigger({ ...settings, hold: 3 });
  const samples: [number, number][] = [
    [100, 0],
    [101, 2],
    [5, 0],
    [6, 2],
  ];
  assert.deepEqual(feed(trigger, samples), [null, 100.5, null, 5.5]);
});

test("no crossing over a sample that is no number", () => {
  assert.deepEqual(
    feed(new Trigger(settings), [
      [0, 0],
      [1, NaN],
      [2, 5],
    ]),
    [null, null, null],
  );
  assert.deepEqual(triggerWindow(10, 4), [8, 12]);
});

test("series are named by variable and elements, and refused with a sentence", () => {
  assert.deepEqual(parseSeries("X Q[2]", variables), [
    { variable: "X", element: 0 },
    { variable: "Q", element: 2 },
  ]);
  assert.equal(parseSeries("Q", variables).length, 6);
  assert.deepEqual(
    parseSeries("Q[1:3]", variables).map((one) => one.element),
    [1, 2],
  );
  assert.throws(() => parseSeries("Q[6]", variables), /Q has elements 0 to 5, not Q\[6\]/);
  assert.throws(() => parseSeries("Y", variables), /there is no variable Y/);
  assert.throws(() => parseSeries(" ", variables), /name a variable/);
});

test("series of different times stand in one table, and in CSV with units", () => {
  const q = new Ring(6),
    x = new Ring(1);
  q.push(1, [0.5, 0, 0, 0, 0, 0]);
  q.push(2, [1.5, 0, 0, 0, 0, 0]);
  x.push(1.5, [7]);
  const series = parseSeries("Q[0] X", variables);
  const table = alignSeries(
    series,
    new Map([
      ["Q", q],
      ["X", x],
    ]),
    -Infinity,
    Infinity,
  );
  assert.deepEqual(table, [
    [1, 1.5, 2],
    [0.5, undefined, 1.5],
    [undefined, 7, undefined],
  ]);
  assert.equal(toCsv(series, table, variables, 1.2), "t (s),Q[0] (rad),X\r\n1.5,,7\r\n2,1.5,\r\n");
});

test("numbers read as on the command line", () => {
  assert.deepEqual(
    [seconds(0.00125), seconds(0), seconds(2.5), seconds(null)],
    ["1.25 ms", "0 s", "2.5 s", "–"],
  );
  assert.deepEqual(
    [number(null), number(3), number(0.12345), number(1e-7)],
    ["–", "3", "0.1235", "1.000e-7"],
  );
  assert.match(clock(0.25), /^\d\d:\d\d:\d\d\.250$/);
});

test("counts of days of cycles stay short", () => {
  assert.deepEqual([0, 99_999, 127_221, 43_200_000, 999_600, 2.5e9].map(count), [
    "0",
    "99999",
    "127 k",
    "43.2 M",
    "1 M",
    "2.5 G",
  ]);
});

test("a stall is shown with when it was, and whether it lasts", () => {
  assert.deepEqual(
    [stallText(0, null), stallText(0, 0), stallText(1, 0), stallText(3, 2.5), stallText(1, null)],
    [
      "",
      "its core stands still now",
      "its core stands still now; its core stood still once",
      "its core stood still 3 times; last 2.5 s ago",
      "its core stood still once",
    ],
  );
});
