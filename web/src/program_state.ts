// The programs that are edited on this page: drafts with undo, their checks, and what runs.
import { program } from "./connection";
import { Keyed, live, useKey } from "./live_state";
import {
  newSeq,
  received,
  sendable,
  type Judged,
  type Line,
  type Listed,
  type SentSeq,
  type Seq,
} from "./program_model";
import type { Answer } from "./protocol";

const CHECK_AFTER = 350; // ms without a further edit
const MOST_UNDO = 200;

interface Past {
  seq: Seq;
  label: string;
}
export interface Draft {
  name: string;
  seq: Seq;
  past: Past[];
  future: Past[];
  /** What its file says, as it was opened or saved; empty: there is no file. */
  saved: string;
  /** How many edits there were when it was saved; -1: that is not among them. */
  savedAt: number;
  /** The lines of its file by their keys, for the line that runs. */
  savedKeys: number[];
  /** What the server knows the file's content by. */
  base: string;
  /** What was said when it was checked last, and which content that was. */
  judged: Judged | null;
  judgedSeq: Seq | null;
  /** Why it could not be checked. */
  refusal: string;
  /** Comments of its file that were lost when it was saved. */
  lost: string[];
}
/** What the form shows: a line by its key, the safe job, or the program itself. */
export type Chosen = number | "safe" | "program";

const text = (seq: Seq): string => JSON.stringify(sendable(seq));

class ProgramState extends Keyed {
  listed: Listed | null = null;
  refusal = "";
  drafts = new Map<string, Draft>();
  name = "";
  chosen: Chosen = "program";
  checking = false;
  private timer: ReturnType<typeof setTimeout> | null = null;
  private asked = 0;

  constructor() {
    super();
    live.subscribe("hello", () => {
      if (this.listed && live.steers) void this.list();
    });
  }

  get draft(): Draft | null {
    return this.drafts.get(this.name) ?? null;
  }
  /** The index of the chosen line; -1: none. */
  get at(): number {
    return this.draft?.seq.lines.findIndex((one) => one.key === this.chosen) ?? -1;
  }
  get line(): Line | null {
    return this.draft?.seq.lines[this.at] ?? null;
  }

  async list(): Promise<void> {
    const answer = await program("list");
    this.refusal = answer.ok ? "" : answer.text;
    const isFirst = !this.listed;
    if (answer.ok) this.listed = answer.data as unknown as Listed;
    this.tell("list");
    if (isFirst && this.listed?.opened && !this.name) await this.open(this.listed.opened);
  }

  choose(what: Chosen): void {
    this.chosen = what;
    this.tell("chosen");
  }
  private show(name: string): void {
    this.name = name;
    this.chosen = "program";
    this.tell("draft", "chosen");
  }

  async open(name: string): Promise<Answer | null> {
    if (this.drafts.has(name)) {
      this.show(name);
      return null;
    }
    const answer = await program("open", { name });
    if (!answer.ok) return answer;
    this.put(name, answer.data as unknown as Judged & { seq: SentSeq; base: string });
    this.show(name);
    return answer;
  }
  private put(name: string, data: Judged & { seq: SentSeq; base: string }): void {
    const seq = received(data.seq);
    this.drafts.set(name, {
      name,
      seq,
      past: [],
      future: [],
      saved: text(seq),
      savedAt: 0,
      savedKeys: seq.lines.map((one) => one.key),
      base: data.base,
      judged: data,
      judgedSeq: seq,
      refusal: "",
      lost: [],
    });
  }
  /** Reads a file again; undo brings back what was edited here. */
  async reread(): Promise<Answer> {
    const answer = await program("open", { name: this.name });
    const draft = this.draft;
    if (!answer.ok || !draft) return answer;
    const data = answer.data as unknown as Judged & { seq: SentSeq; base: string };
    const seq = received(data.seq);
    this.edit("file read again", seq);
    Object.assign(draft, {
      saved: text(seq),
      savedAt: draft.past.length,
      savedKeys: seq.lines.map((one) => one.key),
      base: data.base,
      judged: data,
      judgedSeq: seq,
    });
    this.tell("draft");
    return answer;
  }
  /** Begins a program; the server judges its name. */
  async begin(name: string): Promise<Answer> {
    const seq = newSeq(name);
    const answer = await program("check", { name, seq: sendable(seq) });
    if (!answer.ok) return answer;
    const judged = answer.data as unknown as Judged;
    this.drafts.set(name, {
      name,
      seq,
      past: [],
      future: [],
      saved: "",
      savedAt: -1,
      savedKeys: [],
      base: "",
      judged,
      judgedSeq: seq,
      refusal: "",
      lost: [],
    });
    this.show(name);
    return answer;
  }

  isUnsaved(draft: Draft): boolean {
    return text(draft.seq) !== draft.saved;
  }
  /** What was done since a program was saved, in words. */
  unsaved(draft: Draft): string[] {
    return this.isUnsaved(draft)
      ? this.since(draft).filter((one, k, all) => one !== all[k - 1])
      : [];
  }
  private since(draft: Draft): string[] {
    if (!draft.saved) return ["a new program", ...draft.past.map((one) => one.label)];
    if (draft.savedAt >= 0 && draft.past.length >= draft.savedAt)
      return draft.past.slice(draft.savedAt).map((one) => one.label);
    if (draft.savedAt < 0) return draft.past.map((one) => one.label);
    return draft.future
      .slice(0, draft.savedAt - draft.past.length)
      .map((one) => `undone: ${one.label}`);
  }

  edit(label: string, seq: Seq, choose?: Chosen): void {
    const draft = this.draft;
    if (!draft || seq === draft.seq || text(seq) === text(draft.seq)) return;
    if (draft.savedAt > draft.past.length) draft.savedAt = -1;
    if (draft.past.length >= MOST_UNDO && draft.savedAt >= 0) draft.savedAt--;
    draft.past = [...draft.past, { seq: draft.seq, label }].slice(-MOST_UNDO);
    draft.future = [];
    this.set(draft, seq);
    if (choose !== undefined) this.choose(choose);
  }
  undo(): void {
    const draft = this.draft,
      last = draft?.past.at(-1);
    if (!draft || !last) return;
    draft.past = draft.past.slice(0, -1);
    draft.future = [{ seq: draft.seq, label: last.label }, ...draft.future];
    this.set(draft, last.seq);
  }
  redo(): void {
    const draft = this.draft,
      next = draft?.future[0];
    if (!draft || !next) return;
    draft.future = draft.future.slice(1);
    draft.past = [...draft.past, { seq: draft.seq, label: next.label }];
    this.set(draft, next.seq);
  }
  private set(draft: Draft, seq: Seq): void {
    draft.seq = seq;
    draft.lost = [];
    if (typeof this.chosen === "number" && this.at < 0) this.chosen = "program";
    this.tell("draft", "chosen");
    if (this.timer) clearTimeout(this.timer);
    this.timer = setTimeout(() => void this.check(draft), CHECK_AFTER);
    this.checking = true;
    this.tell("check");
  }
  private async check(draft: Draft): Promise<void> {
    const mine = ++this.asked,
      seq = draft.seq;
    const answer = await program("check", { name: draft.name, seq: sendable(seq) });
    if (mine !== this.asked) return;
    draft.refusal = answer.ok ? "" : answer.text;
    if (answer.ok) {
      draft.judged = answer.data as unknown as Judged;
      draft.judgedSeq = seq;
    }
    this.checking = draft.seq !== seq;
    this.tell("check", "draft");
  }

  async save(): Promise<Answer> {
    const draft = this.draft!,
      seq = draft.seq;
    const answer = await program("save", {
      name: draft.name,
      seq: sendable(seq),
      base: draft.base,
    });
    if (answer.ok) {
      const data = answer.data as unknown as { base: string; lost: string[] };
      Object.assign(draft, {
        base: data.base,
        lost: data.lost,
        saved: text(seq),
        savedKeys: seq.lines.map((one) => one.key),
      });
      draft.savedAt = draft.seq === seq ? draft.past.length : -1;
      await this.list();
    }
    this.tell("draft");
    return answer;
  }
  /** Saves if that is needed; returns the refusal, or null. */
  async saved(): Promise<Answer | null> {
    if (!this.draft || !this.isUnsaved(this.draft)) return null;
    const answer = await this.save();
    return answer.ok ? null : answer;
  }
  /**
   * The key of the line that runs, or comes next after a pause, in the program shown; "safe" for
   * its safe job.
   */
  get lit(): number | "safe" | null {
    const running = live.running,
      draft = this.draft;
    if (!running || !draft || running.program !== draft.name || ENDED.has(running.state.phase))
      return null;
    if (running.state.safe) return "safe";
    return draft.savedKeys[running.state.line] ?? null;
  }
  /** Whether the lit line waits until it is let go on. */
  get isPaused(): boolean {
    return live.running?.state.phase === "paused";
  }
}

export const ENDED = new Set(["done", "failed", "aborted", "stopped"]);
export const programs = new ProgramState();
export const usePrograms = (key: string): number => useKey(programs, key);

window.addEventListener("beforeunload", (event) => {
  if ([...programs.drafts.values()].some((one) => programs.isUnsaved(one))) event.preventDefault();
});
