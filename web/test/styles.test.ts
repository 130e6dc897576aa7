import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

/** The class with which each rule of a stylesheet begins. */
function firstClasses(file: string): Set<string> {
  const css = readFileSync(`src/${file}`, "utf8").replace(/\/\*[^]*?\*\//g, "");
  const selectors = [...css.matchAll(/([^{}]+)\{/g)].flatMap((one) => one[1]!.split(","));
  return new Set(selectors.map((one) => /^\s*(\.[\w-]+)/.exec(one)?.[1] ?? "").filter(Boolean));
}

test("what one part of the page styles is not styled by another one, too", () => {
  const program = firstClasses("program.css"),
    assemble = firstClasses("assemble.css");
  assert.ok(program.has(".tile") && assemble.has(".palette"));
  assert.deepEqual(
    [...program].filter((one) => assemble.has(one)),
    [],
  );
});
