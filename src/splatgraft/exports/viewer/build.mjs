// Writes playcanvas.js from engine.mjs; see README.md. Shaders of WebGPU are left out, as the page draws with WebGL 2.
import { readFile } from "node:fs/promises";
import { build } from "esbuild";

const { version } = JSON.parse(await readFile("node_modules/playcanvas/package.json", "utf8"));
const withoutWebGpu = {
  name: "without-webgpu",
  setup(b) {
    b.onLoad({ filter: /shader-lib[\\/]wgsl[\\/]chunks[\\/].*\.js$/ }, async ({ path }) => {
      const contents = await readFile(path, "utf8");
      const named = [...contents.matchAll(/export\s*\{([^}]*)\}/g)].flatMap((found) => found[1].split(","));
      const isShader = named.length > 0 && named.every((name) => / as default\s*$/.test(name));
      return { contents: isShader ? 'export default "";' : contents };
    });
  },
};
await build({
  entryPoints: ["engine.mjs"],
  outfile: "playcanvas.js",
  bundle: true,
  minify: true,
  format: "iife",
  globalName: "pc",
  legalComments: "none",
  plugins: [withoutWebGpu],
  banner: { js: `/* PlayCanvas engine ${version}, Copyright (c) PlayCanvas Ltd., MIT licence: playcanvas.LICENSE.txt */` },
});
