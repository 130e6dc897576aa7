// The page: its parts, and where they stand.
import { Component, Suspense, lazy, useEffect, type ReactNode } from "react";
import { ChangePanel } from "./change_panel";
import { GraphView } from "./graph_view";
import { VariableNames } from "./controls";
import { live, useLive } from "./live_state";
import { CommandsPanel, EventsPanel } from "./messages_panels";
import { TABS, page, usePage, type Tab } from "./page_state";
import { RunBar } from "./program_run";
import { TaskTable, VariableTable } from "./tables";
import { TaskPanel } from "./task_panel";
import { Bars, LogBar, TopBar } from "./top_bar";

// What is not on the first screen, or comes into it later, is loaded after it.
const AssembleView = lazy(() => import("./editors").then((one) => ({ default: one.AssembleView })));
const ProgramView = lazy(() => import("./editors").then((one) => ({ default: one.ProgramView })));
const PlotsPanel = lazy(() => import("./plots_panel").then((one) => ({ default: one.PlotsPanel })));

const PANELS: Record<Tab, () => React.ReactNode> = {
  Tasks: TaskTable,
  Task: TaskPanel,
  Variables: VariableTable,
  Change: ChangePanel,
  Events: EventsPanel,
  Commands: CommandsPanel,
};
const STEERING: Tab[] = ["Change", "Commands"];

function Side() {
  usePage("tab");
  useLive("hello");
  const tabs = TABS.filter((one) => live.steers || !STEERING.includes(one));
  const tab = tabs.includes(page.tab) ? page.tab : tabs[0]!;
  const Panel = PANELS[tab];
  const go = (event: React.KeyboardEvent) => {
    const by = event.key === "ArrowRight" ? 1 : event.key === "ArrowLeft" ? -1 : 0;
    if (!by) return;
    const next = tabs[(tabs.indexOf(tab) + by + tabs.length) % tabs.length]!;
    page.show(next);
    document.getElementById(`tab-${next}`)?.focus();
  };
  return (
    <aside className="side" aria-label="details">
      <div role="tablist" aria-label="panels" onKeyDown={go}>
        {tabs.map((one) => (
          <button
            key={one}
            id={`tab-${one}`}
            type="button"
            role="tab"
            aria-selected={one === tab}
            aria-controls="panel"
            tabIndex={one === tab ? 0 : -1}
            onClick={() => page.show(one)}
          >
            {one}
            {one === "Events" && <NewErrors />}
          </button>
        ))}
      </div>
      <div key={tab} role="tabpanel" id="panel" aria-labelledby={`tab-${tab}`} tabIndex={-1}>
        <Panel />
      </div>
      {live.role === "observer" && !live.log && (
        <p className="observer-note">
          You are an observer: this page shows everything and steers nothing. The operator’s link
          does.
        </p>
      )}
      {live.log && (
        <p className="observer-note">A recorded run is shown: nothing can be steered.</p>
      )}
    </aside>
  );
}

/** How many errors there are among the events. */
function NewErrors() {
  useLive("events");
  const count = live.events.filter(
    (one) => one.severity === "error" || one.severity === "fatal",
  ).length;
  return count ? (
    <span className="count" aria-label={`${count} errors`}>
      {count}
    </span>
  ) : null;
}

/** What stands below the bars: by what the page is for now. */
function Main() {
  useLive("hello");
  usePage("mode");
  usePage("charts");
  const mode = live.steers ? page.mode : "Watch";
  if (mode === "Assemble") return <AssembleView />;
  if (mode === "Program") return <ProgramView />;
  return (
    <main className={!page.plotsOpen ? "plots-closed" : page.charts.length ? "" : "no-charts"}>
      <GraphView />
      <Suspense fallback={<section className="plots" />}>
        <PlotsPanel />
      </Suspense>
      <Side />
    </main>
  );
}

/** Says that its part of the page has failed, so that Stop and the other parts go on. */
class Guard extends Component<{ children: ReactNode }, { failed: string }> {
  override state = { failed: "" };
  static getDerivedStateFromError(error: unknown) {
    return { failed: String(error) };
  }
  override render() {
    if (!this.state.failed) return this.props.children;
    return (
      <main className="failed" role="alert">
        <p>This part of the page has failed: {this.state.failed}</p>
        <p>
          Stop still works, and nothing was changed in the subsystem.{" "}
          <button type="button" onClick={() => location.reload()}>
            load the page again
          </button>
        </p>
      </main>
    );
  }
}

function Guarded() {
  usePage("mode");
  return (
    <Guard key={page.mode}>
      <Suspense fallback={<main aria-busy="true" />}>
        <Main />
      </Suspense>
    </Guard>
  );
}

export function App() {
  useLive("link");
  useEffect(() => {
    const pressed = (event: KeyboardEvent) => {
      const node = (event.target as HTMLElement).closest?.(".react-flow__node-task");
      if (event.key !== "Enter" || !node || event.target !== node || page.selected.length !== 1)
        return;
      page.openTask(page.selected[0]!);
    };
    window.addEventListener("keyup", pressed);
    return () => window.removeEventListener("keyup", pressed);
  }, []);
  return (
    <div className={`page link-${live.link}`}>
      <TopBar />
      <Bars />
      <LogBar />
      <RunBar />
      <Guarded />
      <VariableNames />
    </div>
  );
}
