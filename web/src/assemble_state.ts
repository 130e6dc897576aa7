// What is chosen in the job that is edited, and how changes of it go.
import { edit, program } from "./connection";
import { Keyed, live, useKey } from "./live_state";
import type { Answer, EditorState, Fit, Graph, SimulatedRun } from "./protocol";
import { doneElsewhere, jobName, newTasks, type Connecting } from "./assemble_words";

export const ASSEMBLE_TABS = ["Details", "Faults", "Simulate", "Save"] as const;
export type AssembleTab = (typeof ASSEMBLE_TABS)[number];
export type Chosen =
  | { kind: "job" }
  | { kind: "task"; task: string }
  | { kind: "port"; task: string; port: string }
  | { kind: "variable"; name: string };

class AssembleState extends Keyed {
  chosen: Chosen = { kind: "job" };
  tab: AssembleTab = "Details";
  jobs: string[] = [];
  /** What the library has to be added, by name. */
  rmods: string[] = [];
  /** The port from which a connection is made by mouse, with what fits it. */
  connecting: Connecting | null = null;
  /** What the mouse is over while a connection is made. */
  over = "";
  /** The last refusal, and the control that caused it. */
  refused: { at: string; text: string } | null = null;
  run: SimulatedRun | null = null;
  /** The state that was simulated. */
  runOf: EditorState | null = null;
  /** What another browser did last to the job, which all browsers edit. */
  elsewhere = "";
  private before: EditorState | null = null;
  private asked = 0;
  private asksBeforeLeaving = false;

  constructor() {
    super();
    live.subscribe("editor", () => this.take(live.editor!));
  }

  get state(): EditorState | null {
    return live.editor;
  }
  get job(): string {
    return this.state ? jobName(this.state.file) : "";
  }
  get isChanged(): boolean {
    return (this.state?.unsaved.length ?? 0) > 0;
  }

  show(tab: AssembleTab): void {
    this.tab = tab;
    this.tell("tab");
  }
  choose(chosen: Chosen): void {
    this.chosen = chosen;
    this.tell("chosen");
    this.show("Details");
  }
  get task(): string {
    return this.chosen.kind === "task" || this.chosen.kind === "port" ? this.chosen.task : "";
  }

  /** Opens the job that is edited, or another one. */
  async open(job = ""): Promise<void> {
    this.askBeforeLeaving();
    if (!(await this.change("open", job ? { job } : {}, "open"))) return this.findJobs();
    if (!job) return;
    this.run = null;
    this.choose({ kind: "job" });
  }

  /**
   * Has the browser ask before it leaves a page with changes that are not saved, whatever it
   * shows.
   */
  private askBeforeLeaving(): void {
    if (this.asksBeforeLeaving) return;
    this.asksBeforeLeaving = true;
    window.addEventListener("beforeunload", (event) => {
      if (this.isChanged) event.preventDefault();
    });
  }

  /** Asks which jobs there are, where the one that was asked for cannot be opened. */
  private async findJobs(): Promise<void> {
    const answer = await program("list");
    if (answer.ok) this.jobs = (answer.data?.jobs as { name: string }[]).map((one) => one.name);
    this.tell("state");
  }

  /**
   * Makes a change; returns whether it was done. A refusal is shown at the control of that name.
   */
  async change(name: string, args: Record<string, unknown>, at: string): Promise<boolean> {
    return (await this.ask(name, args, at)).ok;
  }

  /** Asks something about the job, or changes it. */
  async ask(name: string, args: Record<string, unknown>, at: string): Promise<Answer> {
    const keepsWaiting = name !== "simulate" ? 1 : 0; // a simulation runs beside all else
    this.asked += keepsWaiting;
    this.tell("busy");
    const answer = await edit(name, args);
    this.asked -= keepsWaiting;
    if (!answer.ok) this.refuse({ at, text: answer.text });
    else if (name !== "changes") this.refuse(null);
    this.tell("busy");
    return answer;
  }
  /** Whether an answer is awaited. */
  get busy(): boolean {
    return this.asked > 0;
  }

  refuse(refused: { at: string; text: string } | null): void {
    this.refused = refused;
    this.tell("refused");
  }

  async fitting(task: string, port: string): Promise<Fit[]> {
    const answer = await edit("fitting", { task, port });
    return answer.ok ? (answer.data?.fits as Fit[]) : [];
  }

  /** Begins to make a connection: ports that do not fit are dimmed until it ends. */
  begin(task: string, port: string): void {
    const mine: Connecting = { task, port, fits: [] };
    this.connecting = mine;
    this.over = "";
    void this.fitting(task, port).then((fits) => {
      if (this.connecting !== mine) return;
      this.connecting = { ...mine, fits };
      this.tell("connecting");
    });
  }
  end(): void {
    this.connecting = null;
    this.over = "";
    this.tell("connecting", "over");
  }
  hover(text: string): void {
    if (this.connecting && this.over !== text) {
      this.over = text;
      this.tell("over");
    }
  }

  /** Connects a port to another one, or to a variable. */
  connect(
    task: string,
    port: string,
    to: { task: string; port: string; variable: string },
    at: string,
  ): Promise<boolean> {
    return to.port
      ? this.change("connect_ports", { task, port, other: to.task, other_port: to.port }, at)
      : this.change("connect", { task, port, variable: to.variable }, at);
  }

  private take(state: EditorState): void {
    if (state.jobs) this.jobs = state.jobs;
    const before = this.before;
    this.before = state;
    if (this.connecting) this.end();
    this.keepChoice(before?.graph ?? null, state.graph, state);
    if (!this.busy && before) this.elsewhere = doneElsewhere(before, state) || this.elsewhere;
    else this.elsewhere = "";
    this.tell("state");
  }

  /** Chooses what was added; and a task that got another name by that name. */
  private keepChoice(before: Graph | null, after: Graph, state: EditorState): void {
    const fresh = before && before.job === after.job ? newTasks(before, after) : [];
    const isGone = this.task !== "" && !after.tasks.some((one) => one.name === this.task);
    const noVariable = this.chosen.kind === "variable" && !(this.chosen.name in state.table);
    const follows = this.busy || isGone; // what another browser adds is not chosen here
    if (fresh.length === 1 && follows && (isGone || after.tasks.length > before!.tasks.length))
      this.chosen = { kind: "task", task: fresh[0]! };
    else if (isGone || noVariable) this.chosen = { kind: "job" };
    this.tell("chosen");
  }
}

export const assemble = new AssembleState();
export const useAssemble = (key: string): number => useKey(assemble, key);
/** The job that is edited, as the server judges it; draws again with each change. */
export function useEditor(): EditorState | null {
  useAssemble("state");
  return assemble.state;
}
