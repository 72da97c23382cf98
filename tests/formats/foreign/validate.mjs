// The report of Khronos' validator on a .glb, as JSON: node validate.mjs PACKAGES FILE.glb
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [packages, file] = process.argv.slice(2);
const { default: validator } = await import(pathToFileURL(`${packages}/gltf-validator/index.js`));
const report = await validator.validateBytes(new Uint8Array(readFileSync(file)), { maxIssues: 0 });
console.log(JSON.stringify(report));
