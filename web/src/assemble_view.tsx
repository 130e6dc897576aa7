// The engineer's level: a job is put together from modules of the library.
import { useEffect, useState } from "react";
import { live, useLive } from "./live_state";
import { Canvas } from "./assemble_canvas";
import { Refusal } from "./assemble_fields";
import { DetailsPanel } from "./assemble_forms";
import { Palette } from "./assemble_palette";
import { SavePanel, SimulatePanel } from "./assemble_results";
import {
  ASSEMBLE_TABS,
  assemble,
  useAssemble,
  useEditor,
  type AssembleTab,
} from "./assemble_state";
import { FaultsPanel, Timing } from "./assemble_verdict";
import { fileName } from "./assemble_words";

const PANELS: Record<AssembleTab, () => React.ReactNode> = {
  Details: DetailsPanel,
  Faults: FaultsPanel,
  Simulate: SimulatePanel,
  Save: SavePanel,
};

export function AssembleView() {
  useLive("link");
  const isLive = live.link === "live";
  useEffect(() => {
    if (isLive) void assemble.open();
  }, [isLive]);
  useKeys();
  return (
    <main className="assemble">
      <Tools />
      <Palette />
      <div className="middle">
        <Canvas />
        <Timing />
      </div>
      <Side />
    </main>
  );
}

/** Undo and redo by the usual keys, except in fields, which have their own. */
function useKeys(): void {
  useEffect(() => {
    const pressed = (event: KeyboardEvent) => {
      if (!event.ctrlKey && !event.metaKey) return;
      const key = event.key.toLowerCase(),
        isField = (event.target as HTMLElement).matches?.("input, textarea, select");
      if (key === "s") {
        event.preventDefault();
        assemble.show("Save");
        return;
      }
      if (isField) return;
      if (key === "z" || key === "y") {
        event.preventDefault();
        void assemble.change(key === "y" || event.shiftKey ? "redo" : "undo", {}, "tools");
      }
    };
    window.addEventListener("keydown", pressed);
    return () => window.removeEventListener("keydown", pressed);
  }, []);
}

function Tools() {
  const state = useEditor();
  useAssemble("busy");
  const faults = state?.graph.faults.filter((one) => one.severity !== "warn").length ?? 0;
  return (
    <header className="assemble-tools">
      <Jobs />
      <span className="row" role="group" aria-label="history">
        <button
          type="button"
          disabled={!state?.undo || assemble.busy}
          aria-keyshortcuts="Control+Z"
          title={state?.undo ? `undo: ${state.undo}` : "nothing to undo"}
          onClick={() => void assemble.change("undo", {}, "tools")}
        >
          ↶ undo{state?.undo && <span className="dim label"> {state.undo}</span>}
        </button>
        <button
          type="button"
          disabled={!state?.redo || assemble.busy}
          aria-keyshortcuts="Control+Shift+Z"
          title={state?.redo ? `redo: ${state.redo}` : "nothing to redo"}
          onClick={() => void assemble.change("redo", {}, "tools")}
        >
          ↷ redo{state?.redo && <span className="dim label"> {state.redo}</span>}
        </button>
      </span>
      {state && (
        <button
          type="button"
          className={`flag ${state.legal ? "legal" : "illegal"}`}
          onClick={() => assemble.show("Faults")}
        >
          {state.legal ? "✓ legal" : faults === 1 ? "✕ one fault" : `✕ ${faults} faults`}
        </button>
      )}
      <span className="unsaved" role="status">
        {state && state.unsaved.length > 0 ? (
          <>not saved: {state.unsaved.map(fileName).join(", ")}</>
        ) : state?.graph.tasks.length ? (
          "all is saved"
        ) : (
          ""
        )}
      </span>
      <button
        type="button"
        className={assemble.isChanged ? "primary" : ""}
        aria-keyshortcuts="Control+S"
        onClick={() => assemble.show("Save")}
      >
        save…
      </button>
      {assemble.elsewhere && (
        <p className="outcome warned elsewhere" role="status">
          Another browser {assemble.elsewhere}
        </p>
      )}
      <Refusal at="tools" />
      <Refusal at="open" />
    </header>
  );
}

/** Chooses the job that is edited, or begins a new one; asks first where changes would be lost. */
function Jobs() {
  useAssemble("state");
  const [name, setName] = useState("");
  const open = (job: string) => {
    const lost = assemble.state?.unsaved.map(fileName).join(", ");
    if (
      !lost ||
      window.confirm(`These changes are not saved and would be lost: ${lost}. Open ${job} anyway?`)
    )
      void assemble.open(job);
  };
  const jobs = assemble.jobs.includes(assemble.job)
    ? assemble.jobs
    : [assemble.job, ...assemble.jobs];
  return (
    <span className="row" role="group" aria-label="job">
      <label className="field inline">
        <span>job</span>
        <select value={assemble.job} onChange={(event) => open(event.target.value)}>
          {jobs.map((one) => (
            <option key={one}>{one}</option>
          ))}
        </select>
      </label>
      <form
        className="row"
        onSubmit={(event) => {
          event.preventDefault();
          if (name.trim()) {
            open(name.trim());
            setName("");
          }
        }}
      >
        <input
          value={name}
          size={10}
          placeholder="new job"
          aria-label="name of a new job"
          spellCheck={false}
          onChange={(event) => setName(event.target.value)}
        />
        {name.trim() && <button type="submit">begin</button>}
      </form>
    </span>
  );
}

function Side() {
  const state = useEditor();
  useAssemble("tab");
  const Panel = PANELS[assemble.tab];
  const faults = state?.graph.faults.length ?? 0;
  const go = (event: React.KeyboardEvent) => {
    const by = event.key === "ArrowRight" ? 1 : event.key === "ArrowLeft" ? -1 : 0;
    if (!by) return;
    const next =
      ASSEMBLE_TABS[
        (ASSEMBLE_TABS.indexOf(assemble.tab) + by + ASSEMBLE_TABS.length) % ASSEMBLE_TABS.length
      ]!;
    assemble.show(next);
    document.getElementById(`assemble-${next}`)?.focus();
  };
  return (
    <aside className="side" aria-label="details">
      <div role="tablist" aria-label="panels" onKeyDown={go}>
        {ASSEMBLE_TABS.map((one) => (
          <button
            key={one}
            id={`assemble-${one}`}
            type="button"
            role="tab"
            aria-selected={one === assemble.tab}
            aria-controls="assemble-panel"
            tabIndex={one === assemble.tab ? 0 : -1}
            onClick={() => assemble.show(one)}
          >
            {one}
            {one === "Faults" && faults > 0 && (
              <span className={`count${state?.legal ? " mild" : ""}`}>{faults}</span>
            )}
          </button>
        ))}
      </div>
      <div
        key={assemble.tab}
        role="tabpanel"
        id="assemble-panel"
        aria-labelledby={`assemble-${assemble.tab}`}
        tabIndex={-1}
      >
        <Panel />
      </div>
    </aside>
  );
}
