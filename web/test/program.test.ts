// Programs of jobs: changes of lines, how neighbours fit, and where a check's findings belong.
import assert from "node:assert/strict";
import { test } from "node:test";
import {
  endsText,
  fit,
  hash,
  initials,
  inserted,
  jumps,
  lineText,
  moved,
  newSeq,
  newStep,
  partner,
  received,
  remarks,
  removed,
  replaced,
  said,
  sendable,
  short,
  stepAt,
  structure,
  type Content,
  type Job,
  type Judged,
  type Seq,
  type SentSeq,
} from "../src/program_model";

const end = (signal: string) => ({ signal, task: "", condition: "" });
const make = (...lines: Content[]): Seq => inserted(newSeq("p"), 0, ...lines);
const step = (job: string, more = {}): Content => ({ ...newStep(job), ...more });
const texts = (seq: Seq) => seq.lines.map(lineText);
const REPEAT: Content = { keyword: "REPEAT", times: 2 },
  END: Content = { keyword: "END" };
const job = (name: string, pre: string[], post: string[]): Job => ({
  name,
  desc: "",
  pre,
  post,
  fault: "",
  tasks: [],
});

test("a program is received with places and sent without", () => {
  const place = { file: "p.seq", line: 7, column: 1 };
  const sent = {
    ...newSeq("p"),
    file: "p.seq",
    lines: [{ ...newStep("a"), until: [{ ...end("FINISH"), place }], place }],
  } as unknown as SentSeq;
  assert.deepEqual((sendable(received(sent)) as Seq).lines, [
    { ...newStep("a"), until: [end("FINISH")] },
  ]);
});

test("lines are put in, moved and removed; a loop's ends go together", () => {
  const seq = make(step("a"), REPEAT, step("b"), END, step("c"));
  assert.equal(partner(seq, 1), 3);
  assert.equal(partner(seq, 3), 1);
  assert.equal(partner(seq, 0), -1);
  assert.deepEqual(texts(removed(seq, 3)), ["step a", "step b", "step c"]);
  assert.deepEqual(texts(moved(seq, 0, 5)), [
    "repeat 2 times",
    "step b",
    "end of repeat",
    "step c",
    "step a",
  ]);
  assert.deepEqual(texts(moved(seq, 4, 0)), [
    "step c",
    "step a",
    "repeat 2 times",
    "step b",
    "end of repeat",
  ]);
  assert.equal(moved(seq, 2, 3), seq);
  assert.equal(moved(seq, 0, -1), seq);
  assert.deepEqual(moved(seq, 4, 0).lines[0]!.key, seq.lines[4]!.key);
});

test("a step that gets another name is still led to", () => {
  const seq = make(step("a", { otherwise: "b" }), step("b"), {
    keyword: "GOTO",
    step: "b",
    when: null,
  });
  const named = replaced(seq, 1, step("b", { label: "end" }));
  assert.deepEqual(jumps(named), [
    { from: 0, to: 1, why: "else" },
    { from: 2, to: 1, why: "goto" },
  ]);
  assert.equal(stepAt(make(step("a"), step("a")), "a"), -1);
  assert.equal(stepAt(make(step("a"), step("a", { label: "again" })), "again"), 1);
});

test("loops are drawn around their lines, also where an end is missing", () => {
  const inner = { at: 1, inside: [{ at: 2, inside: null, end: -1 }], end: 3 };
  assert.deepEqual(structure(make(step("a"), REPEAT, step("b"), END)), [
    { at: 0, inside: null, end: -1 },
    inner,
  ]);
  assert.deepEqual(
    structure(make(END, REPEAT, step("b"))).map((one) => one.end),
    [-1, -1],
  );
});

test("neighbours fit as the check says", () => {
  const jobs = [job("a", [], ["X > 1"]), job("b", ["Y > 2"], []), job("bb", [], [])];
  const seq = make(
    step("a", { until: [{ ...end(""), condition: "Z > 3" }] }),
    { keyword: "ORDER", command: "kill", words: ["t"] },
    step("b"),
    step("bb"),
  );
  const judged: Judged = { seq: null, errors: [], warnings: [], notes: [], about: "" };
  assert.equal(fit(seq, 0, jobs, judged), null);
  assert.equal(fit(seq, 1, jobs, judged), null);
  const found = fit(seq, 2, jobs, judged)!;
  assert.deepEqual([found.gives, found.needs, found.mark], [["X > 1", "Z > 3"], ["Y > 2"], "fits"]);
  const unsaid =
    "/x/p.seq:6:1: a -> b: POST of a does not ensure PRE of b: Y > 2; it is asked when the step begins";
  assert.equal(
    fit(seq, 2, jobs, { ...judged, warnings: [unsaid.replace("PRE of b:", "PRE of bb:")] })!.mark,
    "fits",
  );
  assert.equal(fit(seq, 2, jobs, { ...judged, warnings: [unsaid] })!.mark, "asked");
  const never = "/x/p.seq:6:1: a -> b: POST of a and PRE of b can never hold together";
  assert.equal(fit(seq, 2, jobs, { ...judged, errors: [never] })!.mark, "conflict");
  assert.equal(fit(seq, 2, jobs, { ...judged, errors: ["other"] })!.mark, "unknown");
  assert.equal(fit(seq, 3, jobs, judged)!.mark, "fits");
  assert.equal(
    fit(
      make(step("a"), { keyword: "FINISH", failed: false, text: "" }, step("b")),
      2,
      jobs,
      judged,
    ),
    null,
  );
});

test("what a check says is shown at its line", () => {
  const at = (line: number) => ({ file: "p.seq", line, column: 1 });
  const seq = {
    ...newSeq("p"),
    file: "p.seq",
    safe: { ...newStep("s"), place: at(4) },
    lines: [
      { ...newStep("a"), place: at(8) },
      { ...newStep("b"), place: at(10) },
    ],
  } as unknown as SentSeq;
  const judged: Judged = {
    seq,
    errors: ["/x/p.seq:10:3: e"],
    warnings: ["/x/t.rmod:8:1: w", "/x/p.seq:4:1: s"],
    notes: ["/x/p.seq: n", "/x/p.seq:8:1: m"],
    about: "",
  };
  const found = remarks(judged, 2);
  assert.deepEqual(
    [...found].map(([k, list]) => [k, list.map((one) => one.text.at(-1))]).sort(),
    [
      [-1, ["s"]],
      [-2, ["w", "n"]],
      [0, ["m"]],
      [1, ["e"]],
    ].sort(),
  );
  const unwritten = remarks({ ...judged, seq: null, first: 5, errors: ["/x/p.seq:6:12: e"] }, 2);
  assert.equal(unwritten.get(1)![0]!.text, "/x/p.seq:6:12: e");
});

test("texts are short and icons always the same", () => {
  assert.equal(said("/x/p.seq:6:1: a -> b: no"), "a -> b: no");
  assert.equal(said("/x/p.seq: no"), "no");
  assert.equal(
    short("PRE X > 2 (/a/b/lift.job:4:7); see /a/b/c.rmod"),
    "PRE X > 2 (lift.job:4:7); see c.rmod",
  );
  assert.equal(
    endsText({
      ...newStep("a"),
      until: [end("FINISH"), { signal: "", task: "", condition: "X > 1" }],
      seconds: 3,
    }),
    "FINISH or (X > 1) or 3 s",
  );
  assert.deepEqual(["pick_up", "approach", "x"].map(initials), ["PU", "APP", "X"]);
  const jobs = ["approach", "descend", "grasp", "lift", "move", "place", "release", "retreat"];
  assert.equal(
    new Set(jobs.map((one) => `${hash(one) % 6} ${(hash(one) >>> 8) % 12}`)).size,
    jobs.length,
  );
  assert.equal(hash("lift"), 4139838534);
});
