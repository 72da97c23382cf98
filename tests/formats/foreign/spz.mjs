// Niantic's library as WebAssembly: node spz.mjs PACKAGES read IN.spz OUT.json, in the axes right, down, forward
// or node spz.mjs PACKAGES write IN.json OUT.spz VERSION, from the axes right, down, forward.
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [packages, action, input, output, version] = process.argv.slice(2);
const { default: load } = await import(pathToFileURL(`${packages}/@adobe/spz/dist/spz.js`));
const spz = await load({ print: () => {}, printErr: () => {} });
const names = ["positions", "scales", "rotations", "alphas", "colors", "sh"];
const { RDF } = spz.CoordinateSystem;
if (action === "read") {
  const cloud = spz.loadSpzFromBuffer(new Uint8Array(readFileSync(input)), { to: RDF });
  const found = { numPoints: cloud.numPoints, shDegree: cloud.shDegree, antialiased: cloud.antialiased };
  for (const name of names) found[name] = Array.from(cloud[name]);
  found.axes = cloud.extensions.map((e) => e.coordinateSystem?.value ?? null);
  writeFileSync(output, JSON.stringify(found));
} else {
  const cloud = { extensions: [], antialiased: false, ...JSON.parse(readFileSync(input)) };
  for (const name of names) cloud[name] = new Float32Array(cloud[name]);
  const options = { version: Number(version), from: RDF, sh1Bits: 8, shRestBits: 8 };
  writeFileSync(output, spz.saveSpzToBuffer(cloud, options));
}
