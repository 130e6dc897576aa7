// The palette: the library's search, and its modules to be dragged or added.
import { useEffect, useState } from "react";
import { edit } from "./connection";
import { argHelp, commandHelp } from "./controls";
import { unitText } from "./format";
import { live, useLive } from "./live_state";
import type { LibraryModule } from "./protocol";
import { Refusal } from "./assemble_fields";
import { assemble, useAssemble, useEditor } from "./assemble_state";
import { groupModules } from "./assemble_words";

export const DRAGGED = "application/x-pbonet-module";
const PAUSE = 250; // ms without a key, after which the search begins

interface Wanted {
  text: string;
  class: string;
  in: string;
  out: string;
  unit: string;
}
const NOTHING: Wanted = { text: "", class: "", in: "", out: "", unit: "" };

const isAsked = (wanted: Wanted): boolean => Object.values(wanted).some((one) => one.trim());

/** Searches the library, and lists what was found. */
export function Palette() {
  const [wanted, setWanted] = useState(NOTHING);
  const [found, setFound] = useState<LibraryModule[] | null>(null);
  const [classes, setClasses] = useState<string[]>([]);
  const [refused, setRefused] = useState("");
  useLive("link");
  useEditor();
  const job = assemble.job; // RMODs of a job's own are found, too
  const isLive = live.link === "live";
  useEffect(() => {
    let isOld = false;
    const timer = setTimeout(
      async () => {
        const answer = await edit("palette", { ...wanted });
        if (isOld) return;
        const modules = answer.ok ? (answer.data?.modules as LibraryModule[]) : [];
        setRefused(answer.ok ? "" : answer.text);
        setFound(modules);
        if (isAsked(wanted) || !answer.ok) return;
        assemble.rmods = groupModules(modules).flatMap(([, group]) => group.map((one) => one.rmod));
        assemble.tell("rmods");
        setClasses([...new Set(modules.map((one) => one.module_class))].filter(Boolean).sort());
      },
      isAsked(wanted) ? PAUSE : 0,
    );
    return () => {
      isOld = true;
      clearTimeout(timer);
    };
  }, [wanted, isLive, job]);
  const put = (key: keyof Wanted, value: string) => setWanted({ ...wanted, [key]: value });
  const isSearched = isAsked(wanted);
  return (
    <aside className="palette" aria-label="palette of modules">
      <form role="search" onSubmit={(event) => event.preventDefault()}>
        <input
          type="search"
          value={wanted.text}
          placeholder="search the library"
          aria-label="search the library"
          title={argHelp("library", "text")}
          spellCheck={false}
          onChange={(event) => put("text", event.target.value)}
        />
        <details>
          <summary title={commandHelp("library")}>by class, port and unit</summary>
          <label className="field">
            <span>class</span>
            <select value={wanted.class} onChange={(event) => put("class", event.target.value)}>
              <option value="">any</option>
              {classes.map((one) => (
                <option key={one}>{one}</option>
              ))}
            </select>
          </label>
          {(["in", "out", "unit"] as const).map((one) => (
            <label
              className="field"
              key={one}
              title={argHelp("library", one === "in" ? "in_" : one)}
            >
              <span>{one === "in" ? "reads" : one === "out" ? "writes" : "unit"}</span>
              <input
                value={wanted[one]}
                spellCheck={false}
                placeholder={one === "unit" ? "rad" : "Q_*"}
                onChange={(event) => put(one, event.target.value)}
              />
            </label>
          ))}
        </details>
      </form>
      <Refusal at="palette" />
      {refused && (
        <p className="dim palette-none" role="status">
          {refused}
        </p>
      )}
      <div className="modules">
        {!found && <p className="dim palette-none">reading the library…</p>}
        {groupModules(found ?? []).map(([name, modules]) => (
          <details key={`${name} ${isSearched}`} open={isSearched}>
            <summary>
              {name || "without a class"} <span className="dim">{modules.length}</span>
            </summary>
            <ul>
              {modules.map(({ rmod, module }) => (
                <Module key={`${module.name} ${rmod}`} rmod={rmod} module={module} />
              ))}
            </ul>
          </details>
        ))}
      </div>
    </aside>
  );
}

function Module({ rmod, module }: { rmod: string; module: LibraryModule }) {
  useAssemble("busy");
  const add = () => void assemble.change("add_task", { module: rmod }, "palette");
  return (
    <li
      className="module"
      draggable
      tabIndex={0}
      aria-label={`module ${rmod}`}
      onDragStart={(event) => {
        event.dataTransfer.setData(DRAGGED, rmod);
        event.dataTransfer.setData("text/plain", rmod);
        event.dataTransfer.effectAllowed = "copy";
      }}
      onKeyDown={(event) => {
        if (event.key === "Enter" && event.target === event.currentTarget) add();
      }}
    >
      <div className="row">
        <b>{rmod}</b>
        {module.name !== rmod && <span className="dim">{module.name}</span>}
        <button type="button" disabled={assemble.busy} onClick={add} aria-label={`add ${rmod}`}>
          add
        </button>
      </div>
      <p>{module.doc}</p>
      <Ports of={module} inputs />
      <Ports of={module} inputs={false} />
    </li>
  );
}

function Ports({ of, inputs }: { of: LibraryModule; inputs: boolean }) {
  const ports = of.ports.filter((one) => one.kind.startsWith(inputs ? "in" : "out"));
  if (!ports.length) return null;
  return (
    <p className="module-ports">
      <span aria-label={inputs ? "reads" : "writes"}>{inputs ? "→" : "⇒"}</span>
      {ports.map((one) => (
        <code
          key={one.name}
          className={one.kind.endsWith("const") ? "constant" : ""}
          title={`${one.doc}${one.shape.length ? ` [${one.shape.join("×")}]` : ""}${unitText(one.unit) && ` in ${one.unit}`}`}
        >
          {one.name}
        </code>
      ))}
    </p>
  );
}
