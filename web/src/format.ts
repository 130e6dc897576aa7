// Numbers and times as people read them, in the words of the command line.

const PREFIXES: [number, string][] = [
  [1, ""],
  [1e-3, "m"],
  [1e-6, "µ"],
  [1e-9, "n"],
];

export function short(value: number): string {
  if (!Number.isFinite(value)) return String(value);
  if (Math.abs(value) >= 1000) return value.toFixed(0);
  return String(Number(value.toPrecision(3)));
}

/** Returns a count in at most five signs, so that it stays within its place. */
export function count(value: number): string {
  if (value < 1e5) return String(value);
  const [size, word] = value < 999_500 ? [1e3, "k"] : value < 999_500_000 ? [1e6, "M"] : [1e9, "G"];
  return `${Number((value / size).toPrecision(3))} ${word}`;
}

export function seconds(value: number | null | undefined): string {
  if (value === null || value === undefined) return "–";
  if (value === 0) return "0 s";
  for (const [size, prefix] of PREFIXES) {
    if (Math.abs(value) >= size * 0.9995) return `${short(value / size)} ${prefix}s`;
  }
  return `${short(value / 1e-9)} ns`;
}

/** Returns how often a core stood still, when last, and whether it does now; "" if never. */
export function stallText(times: number, age: number | null | undefined): string {
  const parts = age === 0 ? ["its core stands still now"] : [];
  if (times) parts.push(`its core stood still ${times === 1 ? "once" : `${times} times`}`);
  if (times && age) parts.push(`last ${seconds(age)} ago`);
  return parts.join("; ");
}

/** Returns a number in a width that hardly changes. */
export function number(value: number | null | undefined): string {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (Number.isInteger(value) && Math.abs(value) < 1e6) return String(value);
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-4) return value.toExponential(3);
  return value.toFixed(size >= 1000 ? 1 : size >= 10 ? 3 : 4);
}

export function field(value: unknown, unit: string): string {
  if (value === null || value === undefined) return "–";
  if (typeof value !== "number") return String(value);
  if (unit === "s") return seconds(value);
  if (unit === "%") return `${value.toFixed(1)} %`;
  if (unit === "Hz") return `${short(value)} Hz`;
  return String(value);
}

export function clock(t: number, digits = 3): string {
  const date = new Date(t * 1000);
  const two = (n: number) => String(n).padStart(2, "0");
  const text = `${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}`;
  const part = Math.floor((((t % 1) + 1) % 1) * 10 ** digits);
  return digits ? `${text}.${String(part).padStart(digits, "0")}` : text;
}

export const unitText = (unit: string): string => (unit && unit !== "none" ? unit : "");
