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
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const LIMIT = 250_000; // bytes of all files together, each compressed by gzip
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

async function buildPage() {
  const out = join(here, "..", "pbonet", "master", "web", "dist");
  rmSync(out, { recursive: true, force: true });
  mkdirSync(out, { recursive: true });
  const made = await build({
    entryPoints: { app: join(here, "src", "main.tsx") },
    absWorkingDir: here,
    bundle: true,
    minify: true,
    format: "iife",
    target: ["es2022"],
    jsx: "automatic",
    define: { "process.env.NODE_ENV": '"production"' },
    outdir: out,
    legalComments: "none",
    metafile: true,
    logLevel: "warning",
  });
  for (const name of ["index.html", "icon.svg"]) cpSync(join(here, name), join(out, name));
  let size = 0;
  for (const name of readdirSync(out))
    size += gzipSync(readFileSync(join(out, name)), { level: 9 }).length;
  writeFileSync(join(out, "licences.txt"), licences(made.metafile.inputs));
  console.log(`the page takes ${(size / 1000).toFixed(1)} kB by gzip, of ${LIMIT / 1000} kB`);
  if (size > LIMIT) {
    console.error("the page is too large: remove a library, or load it only when it is needed");
    process.exit(1);
  }
}

await (process.argv.includes("--tests") ? buildTests() : buildPage());
