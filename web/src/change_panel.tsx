// Changes of the configuration: swap, switch, start and spawn. What would be done is shown first.
import { useEffect, useMemo, useState } from "react";
import { readingCommand, type Args } from "./connection";
import { Outcome, WordField, argHelp, commandHelp, useCommand } from "./controls";
import { live, useGraph, useLive } from "./live_state";
import { page, usePage } from "./page_state";
import { programs, usePrograms } from "./program_state";
import type { Transition } from "./protocol";

let rmodNames: string[] = [];
/** Asks once for the names of the library's RMODs. */
async function askRmods(then: (names: string[]) => void): Promise<void> {
  if (!rmodNames.length) {
    const answer = await readingCommand("library", {});
    const modules = (answer.data?.modules ?? []) as { name: string; rmods?: string[] }[];
    rmodNames = [
      ...new Set(
        modules
          .flatMap((one) => one.rmods ?? [])
          .map((one) => one.replace(/\.rmod$/, "").replace(/^.*\//, "")),
      ),
    ].sort();
  }
  then(rmodNames);
}
function useRmods(): [string[], () => void] {
  const [names, setNames] = useState(rmodNames);
  return [
    names,
    () => {
      if (!names.length) void askRmods(setNames);
    },
  ];
}

/** The jobs of this subsystem, as commands name them: by their files. */
function useJobs(): string[] {
  usePrograms("list");
  return programs.listed?.jobs.map((one) => one.name) ?? [];
}

export function ChangePanel() {
  useLive("link");
  const isLive = live.link === "live";
  useEffect(() => {
    if (isLive) void programs.list();
  }, [isLive]);
  return (
    <div className="panel">
      <Swap />
      <Switch />
      <Start />
      <Spawn />
    </div>
  );
}

function Swap() {
  const graph = useGraph();
  usePage("selected");
  const [old, setOld] = useState("");
  const [coming, setComing] = useState("");
  const [rtpu, setRtpu] = useState("");
  const [rmods, askNames] = useRmods();
  const tasks = graph?.tasks.map((one) => one.name) ?? [];
  const chosen = old || page.selected.join(",");
  const args: Args = { old: chosen, new: coming.trim(), ...(rtpu ? { rtpu } : {}) };
  return (
    <Planned command="swap" args={args} ready={Boolean(chosen && coming.trim())}>
      <WordField
        label="old"
        hint={argHelp("swap", "old")}
        value={chosen}
        words={tasks}
        change={setOld}
      />
      <WordField
        label="new"
        hint={argHelp("swap", "new")}
        value={coming}
        words={[...tasks, ...rmods]}
        change={setComing}
        focus={askNames}
      />
      <RtpuField label="rtpu" hint={argHelp("swap", "rtpu")} value={rtpu} change={setRtpu} />
    </Planned>
  );
}

function RtpuField(props: {
  label: string;
  hint: string;
  value: string;
  change: (text: string) => void;
}) {
  const graph = useGraph();
  return (
    <label className="field">
      <span>
        {props.label}
        <small>{props.hint}</small>
      </span>
      <select value={props.value} onChange={(event) => props.change(event.target.value)}>
        <option value="">as by default</option>
        {graph?.rtpus.map((one) => (
          <option key={one.name}>{one.name}</option>
        ))}
      </select>
    </label>
  );
}

/** The job of a `switch` or `start`, and how long it may wait for its conditions. */
function JobFields({
  command,
  value,
  setJob,
  setWait,
}: {
  command: string;
  value: { job: string; wait: string };
  setJob: (job: string) => void;
  setWait: (wait: string) => void;
}) {
  const jobs = useJobs();
  return (
    <>
      <WordField
        label="job"
        hint={argHelp(command, "job")}
        value={value.job}
        words={jobs}
        change={setJob}
      />
      <WordField
        label="wait"
        hint={argHelp(command, "wait")}
        value={value.wait}
        words={[]}
        change={setWait}
      />
    </>
  );
}

function Switch() {
  const [job, setJob] = useState("");
  const [wait, setWait] = useState("");
  const name = job.trim();
  return (
    <Planned
      command="switch"
      args={{ ...(name ? { job: name } : {}), ...(wait.trim() ? { wait: wait.trim() } : {}) }}
      ready={Boolean(name)}
    >
      <JobFields command="switch" value={{ job, wait }} setJob={setJob} setWait={setWait} />
    </Planned>
  );
}

function Start() {
  const running = useCommand();
  const [job, setJob] = useState("");
  const [wait, setWait] = useState("");
  const send = () =>
    void running.run("start", {
      ...(job.trim() ? { job: job.trim() } : {}),
      ...(wait.trim() ? { wait: wait.trim() } : {}),
    });
  return (
    <section className="change" aria-label="start">
      <h3>start</h3>
      <p className="dim">{commandHelp("start")}</p>
      <form
        onSubmit={(event) => {
          event.preventDefault();
          send();
        }}
      >
        <JobFields command="start" value={{ job, wait }} setJob={setJob} setWait={setWait} />
        <p className="row">
          <button type="submit" disabled={running.busy || live.link !== "live"}>
            start
          </button>
        </p>
      </form>
      <Outcome of={running} done={<pre>{running.answer?.text || "done"}</pre>} />
    </section>
  );
}

/** A change that is shown first, and done by a second button. */
export function Planned(props: {
  command: string;
  args: Args;
  ready: boolean;
  children: React.ReactNode;
}) {
  const plan = useCommand(),
    deed = useCommand();
  const [planned, setPlanned] = useState("");
  const key = JSON.stringify(props.args);
  const shown =
    plan.answer?.ok && planned === key ? (plan.answer.data as unknown as Transition | null) : null;
  const ask = () => {
    setPlanned(key);
    deed.clear();
    void plan.run(props.command, { ...props.args, dry_run: "yes" });
  };
  const act = () => {
    plan.clear();
    void deed.run(props.command, props.args);
  };
  const offline = live.link !== "live";
  return (
    <section className="change" aria-label={props.command}>
      <h3>{props.command}</h3>
      <p className="dim">{commandHelp(props.command)}</p>
      <form
        onSubmit={(event) => {
          event.preventDefault();
          if (props.ready) ask();
        }}
      >
        {props.children}
        <p className="row">
          <button type="submit" disabled={!props.ready || plan.busy || deed.busy || offline}>
            show what would be done
          </button>
        </p>
      </form>
      {shown ? (
        <div className="plan" role="status">
          <Steps of={shown} />
          {plan.answer!.warnings.map((text) => (
            <pre key={text} className="warning">
              {text}
            </pre>
          ))}
          <p className="row">
            <button type="button" className="primary" disabled={offline} onClick={act}>
              do it
            </button>
            <button type="button" onClick={plan.clear}>
              cancel
            </button>
          </p>
        </div>
      ) : (
        !plan.answer?.ok && <Outcome of={plan} />
      )}
      <Outcome
        of={deed}
        done={
          <>
            <b>done</b>
            {deed.answer?.text && <pre>{deed.answer.text}</pre>}
          </>
        }
      />
    </section>
  );
}

/** What goes, what comes, and what stays. */
function Steps({ of }: { of: Transition }) {
  const off = of.items.filter(([, signal]) => signal === "off").map(([task]) => task);
  const on = of.items.filter(([, signal]) => signal === "on").map(([task]) => task);
  const other = of.items
    .filter(([, signal]) => signal !== "off" && signal !== "on")
    .map(([task, signal]) => `${task} ${signal}`);
  const gives = Object.entries(of.replaces).map(
    ([task, olds]) => `${task} gives the constants of ${olds.join(", ")}`,
  );
  const rows: [string, string, string[]][] = [
    [
      "goes",
      "−",
      [
        ...off.filter((one) => !of.kills.includes(one)).map((one) => `${one}, stays OFF`),
        ...of.kills.map((one) => `${one}, destroyed`),
      ],
    ],
    [
      "comes",
      "+",
      on.map((one) => (of.spawns[one] ? `${one}, created on ${of.spawns[one]}` : one)),
    ],
    [
      "created",
      "+",
      Object.entries(of.spawns)
        .filter(([one]) => !on.includes(one))
        .map(([one, rtpu]) => `${one} on ${rtpu}`),
    ],
    ["also", "·", [...other, ...gives]],
    ["conditions", "·", of.conditions],
    ["stays ON", "=", of.stays],
  ];
  const there = rows.filter(([, , what]) => what.length);
  return (
    <dl className="steps">
      {there.map(([word, sign, what]) => (
        <div key={word} className={`step-${word}`}>
          <dt>
            <span aria-hidden="true">{sign}</span> {word}
          </dt>
          <dd>
            {what.map((one) => (
              <span key={one}>{one}</span>
            ))}
          </dd>
        </div>
      ))}
      {!there.length && <dd>nothing to do</dd>}
    </dl>
  );
}

function Spawn() {
  const running = useCommand();
  const [rmod, setRmod] = useState("");
  const [rtpu, setRtpu] = useState("");
  const [hz, setHz] = useState("");
  const [rmods, askNames] = useRmods();
  const told = useMemo(() => {
    const data = running.answer?.data as
      { states?: Record<string, string>; rtpu?: string } | null | undefined;
    const [name, state] = Object.entries(data?.states ?? {})[0] ?? [];
    return name ? `${name} is ${state} on ${data?.rtpu ?? ""}` : "done";
  }, [running.answer]);
  const send = () =>
    void running.run("spawn", {
      rmod: rmod.trim(),
      ...(rtpu ? { rtpu } : {}),
      ...(hz.trim() ? { hz: hz.trim() } : {}),
    });
  return (
    <section className="change" aria-label="spawn">
      <h3>spawn</h3>
      <p className="dim">{commandHelp("spawn")}</p>
      <form
        onSubmit={(event) => {
          event.preventDefault();
          if (rmod.trim()) send();
        }}
      >
        <WordField
          label="rmod"
          hint={argHelp("spawn", "rmod")}
          value={rmod}
          words={rmods}
          change={setRmod}
          focus={askNames}
        />
        <RtpuField label="rtpu" hint={argHelp("spawn", "rtpu")} value={rtpu} change={setRtpu} />
        <WordField label="hz" hint={argHelp("spawn", "hz")} value={hz} words={[]} change={setHz} />
        <p className="row">
          <button type="submit" disabled={!rmod.trim() || running.busy || live.link !== "live"}>
            spawn
          </button>
        </p>
      </form>
      <Outcome of={running} done={told} />
    </section>
  );
}
