// Builds the page into pbonet/master/web/dist, or with --tests the tests into build/.
import { build } from "esbuild";
import { gzipSync } from "node:zlib";
import {
  cpSync,
  existsSync,
  mkdirSync,
  readFileSync,
  readdirSync,
  rmSync,
  writeFileSync,
} from "node:fs";
import { basename, dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const LIMIT = 250_000; // bytes of all files together, each compressed by gzip
const FIRST_LIMIT = 195_000; // of those that the first screen waits for
const here = dirname(fileURLToPath(import.meta.url));

async function buildTests() {
  const out = join(here, "build");
  rmSync(out, { recursive: true, force: true });
  const files = readdirSync(join(here, "test")).filter((name) => name.endsWith(".test.ts"));
  await build({
    entryPoints: files.map((name) => join(here, "test", name)),
    bundle: true,
    platform: "node",
    format: "esm",
    outdir: out,
    outExtension: { ".js": ".test.mjs" },
    logLevel: "warning",
  });
}

/** Returns the licences of all packages of which something is in the page. */
function licences(inputs) {
  const folders = new Set();
  for (const file of Object.keys(inputs)) {
    const found = /^(.*node_modules\/(?:@[^/]+\/)?[^/]+)\//.exec(file);
    if (found) folders.add(found[1]);
  }
  return [...folders]
    .sort()
    .map((folder) => {
      const about = JSON.parse(readFileSync(join(here, folder, "package.json"), "utf8"));
      const name = ["LICENSE", "LICENSE.md", "LICENSE.txt", "license"].find((one) =>
        existsSync(join(here, folder, one)),
      );
      const text = name
        ? readFileSync(join(here, folder, name), "utf8").trim()
        : `License: ${about.license}`;
      return `${about.name} ${about.version}\n\n${text}\n`;
    })
    .join(`\n${"-".repeat(72)}\n\n`);
}

/** Returns the files that app.js loads at once, itself included. */
function loadedFirst(outputs) {
  const found = new Set();
  const visit = (path) => {
    if (found.has(path)) return;
    found.add(path);
    for (const one of outputs[path].imports) {
      if (one.kind === "import-statement" && outputs[one.path]) visit(one.path);
    }
  };
  visit(Object.keys(outputs).find((path) => path.endsWith("/app.js")));
  return [...found].map((path) => basename(path));
}

async function buildPage() {
  const out = join(here, "..", "pbonet", "master", "web", "dist");
  rmSync(out, { recursive: true, force: true });
  mkdirSync(out, { recursive: true });
  const made = await build({
    entryPoints: { app: join(here, "src", "main.tsx") },
    absWorkingDir: here,
    bundle: true,
    minify: true,
    format: "esm",
    splitting: true,
    chunkNames: "[name]-[hash]",
    target: ["es2022"],
    jsx: "automatic",
    define: { "process.env.NODE_ENV": '"production"' },
    outdir: out,
    legalComments: "none",
    metafile: true,
    logLevel: "warning",
  });
  for (const name of ["index.html", "icon.svg"]) cpSync(join(here, name), join(out, name));
  const sizes = new Map(
    readdirSync(out).map((name) => [
      name,
      gzipSync(readFileSync(join(out, name)), { level: 9 }).length,
    ]),
  );
  const sum = (names) => names.reduce((total, name) => total + sizes.get(name), 0);
  const size = sum([...sizes.keys()]);
  const first = sum(["index.html", "icon.svg", "app.css", ...loadedFirst(made.metafile.outputs)]);
  writeFileSync(join(out, "licences.txt"), licences(made.metafile.inputs));
  const kB = (bytes) => (bytes / 1000).toFixed(1);
  console.log(
    `the page takes ${kB(size)} kB by gzip, of ${kB(LIMIT)} kB; ` +
      `its first screen ${kB(first)} kB, of ${kB(FIRST_LIMIT)} kB`,
  );
  if (size > LIMIT || first > FIRST_LIMIT) {
    console.error("the page is too large: remove a library, or load it only when it is needed");
    process.exit(1);
  }
}

await (process.argv.includes("--tests") ? buildTests() : buildPage());
