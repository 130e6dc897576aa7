// The verdict on the job that is edited: its faults with what puts them right, and the load of
// each RTPU.
import { short } from "./format";
import type { Offer, TimingBar } from "./protocol";
import { Refusal } from "./assemble_fields";
import { assemble, useAssemble, useEditor } from "./assemble_state";
import { barOf, faultHead, faultsOf, type NumberedFault } from "./assemble_words";

export function FaultsPanel() {
  const state = useEditor();
  if (!state) return null;
  const faults = faultsOf(state);
  const common = state.offers.filter((one) => one.faults.length > 1);
  return (
    <div className="panel">
      {!faults.length && (
        <p>
          <span className="flag legal">✓ legal</span> This job has no fault: it may be started.
        </p>
      )}
      {common.length > 0 && (
        <section>
          <h3>For several faults</h3>
          <Offers offers={common} at="common" />
        </section>
      )}
      {faults.map((one) => (
        <FaultCard key={`${one.number} ${one.fault.text}`} of={one} but={common} />
      ))}
    </div>
  );
}

/** A fault in words, the tasks at which it is, and what puts it right. */
export function FaultCard({
  of: { number, fault, offers },
  but = [],
}: {
  of: NumberedFault;
  but?: Offer[];
}) {
  const head = faultHead(fault.text);
  const isWarning = fault.severity === "warn";
  return (
    <section
      className={`fault-card ${isWarning ? "warning" : "refuse"}`}
      aria-label={`fault: ${head}`}
    >
      <p>
        <b>{isWarning ? "⚠" : "✕"}</b> {head}
      </p>
      <details>
        <summary className="dim">in full</summary>
        <pre>{fault.text}</pre>
        {fault.remedy && !fault.text.includes(fault.remedy) && <pre>{fault.remedy}</pre>}
      </details>
      {fault.tasks.length > 0 && (
        <p className="row wrap">
          {[...new Set(fault.tasks)].map((task) => (
            <button
              key={task}
              type="button"
              className="link"
              onClick={() => assemble.choose({ kind: "task", task })}
            >
              {task}
            </button>
          ))}
        </p>
      )}
      <Offers offers={offers.filter((one) => !but.includes(one))} at={`fault ${number}`} />
    </section>
  );
}

function Offers({ offers, at }: { offers: Offer[]; at: string }) {
  useAssemble("busy");
  return (
    <>
      {offers.length > 0 && (
        <p className="offers">
          {offers.map((one) => (
            <button
              key={one.text}
              type="button"
              className={`offer offer-${one.kind}`}
              disabled={assemble.busy}
              onClick={() => void assemble.change("apply", { offer: one }, at)}
            >
              {one.text}
            </button>
          ))}
        </p>
      )}
      <Refusal at={at} />
    </>
  );
}

/** The load of each RTPU against the bound of its scheduler. */
export function Timing() {
  const state = useEditor();
  if (!state) return null;
  if (!state.timing.length)
    return (
      <section className="timing" aria-label="timing of each RTPU">
        <p className="dim">
          The timing is not known while a part of the job cannot be read: see the faults.
        </p>
      </section>
    );
  return (
    <section className="timing" aria-label="timing of each RTPU">
      {state.timing.map((one) => (
        <RtpuLoad key={one.rtpu} of={one} />
      ))}
    </section>
  );
}

function RtpuLoad({ of }: { of: TimingBar }) {
  const bar = barOf(of);
  const used = of.tasks.filter((one) => (one.utilization ?? 0) > 0);
  const whole = Math.max(1, of.utilization ?? 0, of.bound ?? 1);
  return (
    <div className={`rtpu-load${of.late.length ? " late" : ""}`}>
      <div className="row">
        <b>{of.rtpu}</b>
        <span className="dim" title={of.text}>
          {of.text.replace(/^RTPU [^:]*: /, "")}
        </span>
      </div>
      <div
        className="load-bar"
        role="meter"
        aria-label={`load of ${of.rtpu}`}
        aria-valuemin={0}
        aria-valuemax={100}
        aria-valuenow={Math.round((of.utilization ?? 0) * 100)}
        aria-valuetext={of.text}
      >
        {used.map((one) => (
          <i
            key={one.task}
            className={of.late.includes(one.task) ? "late" : ""}
            style={{ width: `${(100 * one.utilization!) / whole}%` }}
            title={`${one.task} ${short(one.utilization! * 100)} %`}
          />
        ))}
        {of.bound !== null && (
          <u style={{ left: `${bar.bound}%` }} title={`bound ${short(of.bound * 100)} %`} />
        )}
      </div>
      {(of.late.length > 0 || of.unknown.length > 0) && (
        <p>
          {of.late.length > 0 && (
            <span className="bad">
              <b>may be late:</b> {of.late.join(", ")}{" "}
            </span>
          )}
          {of.unknown.length > 0 && (
            <span className="dim">MAXC unknown: {of.unknown.join(", ")}</span>
          )}
        </p>
      )}
    </div>
  );
}
