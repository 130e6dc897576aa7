// The fields of the forms: each says what it sets when it is left, and shows its refusal.
import { useEffect, useId, useState, type ReactNode } from "react";
import { assemble, useAssemble } from "./assemble_state";

/** The refusal of the control of this name, word for word. */
export function Refusal({ at }: { at: string }) {
  useAssemble("refused");
  const refused = assemble.refused;
  if (refused?.at !== at) return null;
  return (
    <div className="outcome refusal" role="alert">
      <button
        type="button"
        className="close"
        aria-label="close this message"
        onClick={() => assemble.refuse(null)}
      >
        ×
      </button>
      <pre>{refused.text}</pre>
    </div>
  );
}

interface Common {
  label: ReactNode;
  at: string;
  hint?: string;
  unit?: string;
  wide?: boolean;
}

/** A text that is set by Enter, or when the field is left. Escape takes it back. */
export function TextField(
  props: Common & {
    value: string;
    set: (text: string) => void;
    words?: readonly string[];
    placeholder?: string;
    lines?: number;
    once?: boolean;
  },
) {
  const [text, setText] = useState(props.value);
  const list = useId();
  useEffect(() => setText(props.value), [props.value]);
  const commit = () => {
    if (text === props.value) return;
    props.set(text);
    if (props.once) setText("");
  };
  const shared = {
    value: text,
    spellCheck: false,
    placeholder: props.placeholder ?? "",
    onBlur: commit,
    onChange: (event: { target: { value: string } }) => setText(event.target.value),
    onKeyDown: (event: React.KeyboardEvent) => {
      if (event.key === "Escape") setText(props.value);
      if (event.key === "Enter" && !(props.lines && !event.ctrlKey)) {
        event.preventDefault();
        commit();
      }
    },
  };
  return (
    <div className={props.wide ? "wide" : ""}>
      <label className="field" title={props.hint}>
        <span>
          {props.label}
          {props.unit && <small>{props.unit}</small>}
        </span>
        {props.lines ? (
          <textarea rows={props.lines} {...shared} />
        ) : (
          <input list={props.words ? list : undefined} autoComplete="off" {...shared} />
        )}
        {props.words && (
          <datalist id={list}>
            {props.words.slice(0, 300).map((one) => (
              <option key={one} value={one} />
            ))}
          </datalist>
        )}
      </label>
      <Refusal at={props.at} />
    </div>
  );
}

export function ChoiceField(
  props: Common & {
    value: string;
    choices: readonly (readonly [string, string])[];
    set: (value: string) => void;
  },
) {
  return (
    <div>
      <label className="field" title={props.hint}>
        <span>
          {props.label}
          {props.unit && <small>{props.unit}</small>}
        </span>
        <select value={props.value} onChange={(event) => props.set(event.target.value)}>
          {props.choices.map(([value, text]) => (
            <option key={value} value={value}>
              {text}
            </option>
          ))}
        </select>
      </label>
      <Refusal at={props.at} />
    </div>
  );
}

export function CheckField(props: Common & { value: boolean; set: (value: boolean) => void }) {
  return (
    <div>
      <label className="check" title={props.hint}>
        <input
          type="checkbox"
          checked={props.value}
          onChange={(event) => props.set(event.target.checked)}
        />
        <span>{props.label}</span>
      </label>
      <Refusal at={props.at} />
    </div>
  );
}
