// Words that may come next on a command line, from the command table and known names.
import type { Command } from "./protocol";

/** Names by the kind of thing that an argument names. */
export type Names = Record<string, readonly string[]>;

/** Returns the words that may replace the last one in `text`, sorted. */
export function complete(text: string, commands: readonly Command[], names: Names): string[] {
  const words = text.trimStart().split(/\s+/);
  const last = words.pop() ?? "";
  const offers = words.length
    ? argumentWords(words, last, commands, names)
    : commands.map((one) => one.name.split(" ")[0]!);
  return [...new Set(offers)].filter((one) => one.startsWith(last) && one !== last).sort();
}

function argumentWords(
  words: string[],
  last: string,
  commands: readonly Command[],
  names: Names,
): string[] {
  const two = commands.find((one) => one.name === words.slice(0, 2).join(" "));
  const one = commands.find((each) => each.name === words[0]);
  const seconds =
    words.length === 1
      ? commands
          .filter((each) => each.name.startsWith(`${words[0]} `))
          .map((each) => each.name.split(" ")[1]!)
      : [];
  const found = words.length > 1 && two ? two : one;
  if (!found) return seconds;
  const given = words.slice(found.name.split(" ").length);
  return [...seconds, ...placesWords(found, given, last, names)];
}

function placesWords(command: Command, given: string[], last: string, names: Names): string[] {
  const options = command.args.filter((one) => one.use === "named");
  const equals = last.indexOf("=");
  if (equals > 0) {
    const option = command.args.find((one) => one.name === last.slice(0, equals));
    return option
      ? kindWords(option.kind, given, names).map((word) => `${option.name}=${word}`)
      : [];
  }
  const plain = given.filter((word) => !options.some((one) => word.startsWith(`${one.name}=`)));
  const places = command.args.filter((one) => one.use !== "named");
  const many = (use: string) => use === "some" || use === "any";
  const place =
    places[plain.length] ??
    (places.length && many(places.at(-1)!.use) ? places.at(-1)! : undefined);
  const free = options.filter((one) => !given.some((word) => word.startsWith(`${one.name}=`)));
  return [
    ...(place ? kindWords(place.kind, given, names) : []),
    ...free.map((one) => `${one.name}=`),
  ];
}

function kindWords(kind: string, given: string[], names: Names): readonly string[] {
  if (kind === "yes") return ["yes", "no"];
  if (kind === "parameter") return names[`parameter ${given[0] ?? ""}`] ?? [];
  return names[kind] ?? [];
}
