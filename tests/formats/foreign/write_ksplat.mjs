// Write a .ksplat from a PLY with mkkellogg's library: node write_ksplat.mjs FOLDER_OF_PACKAGES IN.ply OUT.ksplat LEVEL DEGREE
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [packages, input, output, level, degree] = process.argv.slice(2);
const library = `${packages}/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js`;
globalThis.window ??= globalThis; // the library asks for it when it is loaded
globalThis.navigator ??= { userAgent: "" };
const { PlyParser, SplatBufferGenerator } = await import(pathToFileURL(library));
const file = readFileSync(input);
const ply = file.buffer.slice(file.byteOffset, file.byteOffset + file.length);
const splats = PlyParser.parseToUncompressedSplatArray(ply, Number(degree));
const generator = SplatBufferGenerator.getStandardGenerator(0, Number(level), 0, undefined, 5, 16);
writeFileSync(output, Buffer.from(generator.generateFromUncompressedSplatArray(splats).bufferData));
