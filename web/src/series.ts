// Series of charts: their names, aligned tables of them, and CSV text.

import type { Variable } from "./protocol";
import type { Ring } from "./ring";

export interface Series {
  variable: string;
  element: number;
}

const MOST_ELEMENTS = 6;

export const seriesName = (one: Series, variable?: Variable): string =>
  variable && variable.n === 1 ? one.variable : `${one.variable}[${one.element}]`;

/**
 * Returns the series that a text names: `Q_MEZ`, `Q_MEZ[2]` or `Q_MEZ[0:3]`, several with spaces.
 * Throws an error with a sentence for the user.
 */
export function parseSeries(text: string, variables: ReadonlyMap<string, Variable>): Series[] {
  const found: Series[] = [];
  for (const word of text.trim().split(/\s+/).filter(Boolean)) {
    const parts = /^([^[\]]+)(?:\[(\d+)(?::(\d+))?\])?$/.exec(word);
    const variable = parts ? variables.get(parts[1]!) : undefined;
    if (!parts || !variable) throw new Error(`there is no variable ${word}`);
    const from = parts[2] === undefined ? 0 : Number(parts[2]);
    const to =
      parts[3] !== undefined
        ? Number(parts[3])
        : parts[2] !== undefined
          ? from + 1
          : Math.min(variable.n, MOST_ELEMENTS);
    if (from >= variable.n || to > variable.n || to <= from) {
      throw new Error(`${variable.name} has elements 0 to ${variable.n - 1}, not ${word}`);
    }
    for (let element = from; element < to; element++)
      found.push({ variable: variable.name, element });
  }
  if (!found.length) throw new Error("name a variable, such as Q_MEZ or Q_MEZ[2]");
  return found;
}

export type Table = [number[], ...(number | null | undefined)[][]];

/** Returns one column of times, and one of each series; undefined where it has no sample. */
export function alignSeries(
  series: readonly Series[],
  rings: ReadonlyMap<string, Ring>,
  from: number,
  to: number,
): Table {
  const columns = series.map(
    (one) => rings.get(one.variable)?.between(one.element, from, to) ?? [[], []],
  ) as [number[], (number | null)[]][];
  const times = [...new Set(columns.flatMap(([t]) => t))].sort((a, b) => a - b);
  const place = new Map(times.map((t, k) => [t, k]));
  const rows = columns.map(([t, v]) => {
    const row = new Array<number | null | undefined>(times.length).fill(undefined);
    t.forEach((time, k) => {
      row[place.get(time)!] = v[k];
    });
    return row;
  });
  return [times, ...rows];
}

/** Returns a table as CSV: time in seconds, then one column per series with its unit. */
export function toCsv(
  series: readonly Series[],
  table: Table,
  variables: ReadonlyMap<string, Variable>,
  from = -Infinity,
  to = Infinity,
): string {
  const head = series.map((one) => {
    const variable = variables.get(one.variable);
    const unit = variable && variable.unit && variable.unit !== "none" ? ` (${variable.unit})` : "";
    return csvCell(seriesName(one, variable) + unit);
  });
  const lines = [["t (s)", ...head].join(",")];
  table[0].forEach((t, k) => {
    if (t < from || t > to) return;
    const cells = table.slice(1).map((column) => {
      const v = column[k];
      return v === null || v === undefined ? "" : String(v);
    });
    lines.push([String(t), ...cells].join(","));
  });
  return `${lines.join("\r\n")}\r\n`;
}

function csvCell(text: string): string {
  // A spreadsheet would take it for a formula
  const safe = /^[=+\-@]/.test(text) ? `'${text}` : text;
  return /[",\r\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}
