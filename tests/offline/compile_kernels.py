"""Compile every kernel for GPUs of AMD, NVIDIA and Intel, without a GPU, and check what it uses.

Run by `make check-builds`, which needs Clang 19 and libclc (Debian: apt install clang-19 libclc-19), and an OpenCL
device, such as PoCL, to find out which programs the launches build. For NVIDIA, `ptxas` (of CUDA, or of PyPI's
nvidia-cuda-nvcc-cu12) says what its assembler takes; without it, kernels are compiled to PTX alone. For Intel,
`ocloc` is the compiler of its GPU driver (Debian: in intel-opencl-icd); without it, that target is left out.

The programs are those that the self-test of a device builds with the variants for GPUs, in single precision. Each is
also parsed as strict OpenCL C 1.2. Those that can use subgroups are parsed with them as well, in the languages that
have them; libclc has no code for their functions. For Intel they are compiled with them.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.device import Device
from clsplat.ops.composite import GPU_BATCH
from clsplat.programs import SUBGROUP_LANGUAGES, build_options, inline_includes, kernel_folder
from clsplat.selftest import faults

# Processor, and the triple, the options and the library of libclc with which Clang compiles for it.
AMD = ("amdgcn-mesa-mesa3d", "{}-amdgcn-mesa-mesa3d.bc")
NVIDIA = ("nvptx64-nvidia-nvcl", "nvptx64--nvidiacl.bc")
TARGETS = {"gfx90a": AMD, "gfx1030": AMD, "gfx1100": AMD, "sm_70": NVIDIA, "sm_90": NVIDIA}

INTEL = "dg2"
"""The processor of Intel's Arc A GPUs, for which `ocloc` compiles."""

EXTENSIONS = ["-Xclang", "-cl-ext=+cl_khr_subgroups,+__opencl_c_subgroups"]

# Clang's warnings that are not about the language: pragmas for one compiler, and literals that the option
# -cl-single-precision-constant makes single.
STRICT = ["-pedantic", "-Werror", "-Wall", "-Wno-unused-function", "-Wno-unknown-pragmas"]

PRIVATE_MAX = 64
"""Largest private memory of a work-item, bytes. NVIDIA's driver reserves it for each work-item that can be resident,
270 000 on an H200, and accesses to it are those of global memory. Compilers may spill a few registers."""

PRIVATE_LARGER = {"bin_histogram": 1028, "bin_scatter": 1028}
"""Private memory of kernels that may have more, bytes: those that are launched on CPUs alone."""

LOCAL_MAX = 32768
"""Largest local memory of a work-group, bytes: what OpenCL 1.2 guarantees."""

REGISTERS_MAX = 255
"""Largest number of registers of a work-item on NVIDIA's GPUs. Beyond, values go to private memory."""


def programs() -> list[tuple[str, dict[str, Any]]]:
    """Stage and defines of each program for GPUs, as the launches of the self-test build them."""
    os.environ["CLSPLAT_VARIANTS"] = "gpu"
    device, found = Device(), {}
    program = Device.program

    def recorded(self: Device, stage: str, defines: dict[str, Any]) -> Any:
        values = self.model | defines
        if "SUBGROUPS" in values:
            values |= {"SUBGROUPS": 0, "BATCH": GPU_BATCH}
        found[stage, tuple(sorted(values.items()))] = stage, values
        return program(self, stage, defines)

    Device.program = recorded  # type: ignore[method-assign]
    wrong = faults(device)
    assert not wrong, f"the self-test fails on {device.label}: {wrong}"
    return [*found.values()]


class Compiler:
    """Clang with the built-in functions of libclc, and ptxas and ocloc if they are there."""

    def __init__(self, clang: str, library: Path, folder: Path):
        self.clang, self.library, self.folder = clang, library, folder
        self.ptxas, self.ocloc = shutil.which("ptxas"), shutil.which("ocloc")

    def run(self, source: str, options: list[str], *more: str) -> str:
        """Compile a source; returns what Clang says. Ends the script with the errors if it fails."""
        path = self.folder / "kernel.cl"
        path.write_text(source + "\n")
        # -cl-mad-enable contracts operations as drivers do.
        command = [self.clang, "-x", "cl", *options, "-Xclang", "-finclude-default-header", *more, str(path)]
        result = subprocess.run(command, capture_output=True, text=True)
        if result.returncode:
            sys.exit(f"{' '.join(command)}\n{result.stderr[:4000]}")
        return result.stderr

    def kernels(self, source: str, options: list[str], target: str) -> Iterator[dict[str, Any]]:
        """What each kernel of a program uses on a processor."""
        triple, library = TARGETS[target]
        out = self.folder / "kernel.s"
        bitcode = str(self.library / library.format(target))
        more = ["-target", triple, "-nogpulib", "-O3", "-w", "-Xclang", "-mlink-builtin-bitcode", "-Xclang", bitcode]
        cpu = f"-mcpu={target}" if triple == AMD[0] else f"-march={target}"
        self.run(source, options, *more, cpu, "-Xclang", "-target-cpu", "-Xclang", target, "-S", "-o", str(out))
        yield from self.amd(out.read_text()) if triple == AMD[0] else self.nvidia(out, target)

    def amd(self, assembly: str) -> Iterator[dict[str, Any]]:
        """Registers and memory as comments of the assembly name them."""
        fields = {
            "registers": r"; NumVgprs: (\d+)",
            "private": r"; ScratchSize: (\d+)",
            "local": r"; LDSByteSize: (\d+)",
            "occupancy": r"; Occupancy: (\d+)",
        }
        for part in assembly.split("; Kernel info:")[1:]:
            values = {name: int(re.search(pattern, part)[1]) for name, pattern in fields.items()}  # type: ignore[index]
            yield values
        names = re.findall(r"\.type\s+(\w+),@function", assembly)
        yield {"names": names}

    def nvidia(self, path: Path, target: str) -> Iterator[dict[str, Any]]:
        """Registers and memory as ptxas reports them."""
        if self.ptxas is None:
            return
        command = [self.ptxas, "-v", f"-arch={target}", str(path), "-o", os.devnull]
        result = subprocess.run(command, capture_output=True, text=True)
        said, names = result.stderr + result.stdout, []
        if "is not defined for option 'gpu-name'" in said:  # CUDA 13 no longer assembles for sm_70
            return
        if result.returncode:
            sys.exit(f"{' '.join(command)}\n{said[:4000]}")
        for part in said.split("Compiling entry function ")[1:]:
            names.append(re.match(r"'(\w+)'", part)[1])  # type: ignore[index]
            local = re.search(r"(\d+) bytes smem", part)
            yield {
                "registers": int(re.search(r"Used (\d+) registers", part)[1]),  # type: ignore[index]
                "private": int(re.search(r"(\d+) bytes stack frame", part)[1]),  # type: ignore[index]
                "local": int(local[1]) if local else 0,
            }
        yield {"names": names}

    def intel(self, source: str, options: list[str]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Name of each kernel of a program and what it uses on a GPU of Intel, as its driver's compiler says."""
        if self.ocloc is None:
            return
        path, out = self.folder / "kernel.cl", self.folder / "intel"
        path.write_text(source + "\n")
        # A binary of this format holds a list of its kernels as YAML.
        command = [self.ocloc, "compile", "-file", str(path), "-device", INTEL, "--format", "zebin"]
        command += ["-options", " ".join([*options, "-w"]), "-out_dir", str(out)]
        result = subprocess.run(command, capture_output=True, text=True)
        if result.returncode:
            sys.exit(f"{' '.join(command)}\n{result.stdout[:4000]}{result.stderr[:4000]}")
        (binary,) = out.glob("*.bin")
        yield from intel_kernels(binary.read_bytes())


def intel_kernels(binary: bytes) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name of each kernel of a binary for a GPU of Intel, and what it uses. Registers are those of a thread, which
    runs as many work-items as it has lanes."""
    begin = binary.index(b"kernels:")
    text = binary[begin : binary.index(b"\0", begin)].decode().partition("kernels_misc_info:")[0]
    for part in re.split(r"^  - name: +", text, flags=re.MULTILINE)[1:]:
        found = {name: int(value) for name, value in re.findall(r"^ {6}(\w+): +(\d+)$", part, re.MULTILINE)}
        memory = part.partition("per_thread_memory_buffers:")[2]
        # Of a work-item or, without the mark, of a thread.
        buffers = re.findall(r"size: +(\d+)\n(?: +slot: +\d+\n)?( +is_simt_thread: +true)?", memory)
        private = sum(int(size) if mark else int(size) / found["simd_size"] for size, mark in buffers)
        uses = {"registers": found["grf_count"], "private": private, "local": found.get("slm_size", 0)}
        if part.startswith("Intel_Symbol_Table"):  # not one of the sources
            continue
        yield part.split()[0], uses | {"lanes": found["simd_size"]}


def measure(compiler: Compiler) -> list[dict[str, Any]]:
    """What every kernel uses on every target."""
    rows = []

    def add(stage: str, name: str, target: str, use: dict[str, Any]) -> None:
        rows.append({"stage": stage, "kernel": name, "target": target} | use)
        print(f"{stage:15} {name:24} {target:8} {use}", flush=True)

    for stage, defines in programs():
        source, options = inline_includes(f"{stage}.cl", kernel_folder()), build_options(np.float32, defines)
        compiler.run(source, options, "-fsyntax-only", "-target", "spir64", *STRICT)
        for language, _ in SUBGROUP_LANGUAGES if "SUBGROUPS" in defines else ():
            compiler.run(
                source,
                build_options(np.float32, defines | {"SUBGROUPS": 1}, language),
                *("-fsyntax-only", "-target", AMD[0], *EXTENSIONS),
            )
        for target in TARGETS:
            *uses, last = list(compiler.kernels(source, options, target)) or [{"names": []}]
            for name, use in zip(last["names"], uses, strict=True):
                add(stage, name, target, use)
        if "SUBGROUPS" in defines:
            options = build_options(np.float32, defines | {"SUBGROUPS": 1}, SUBGROUP_LANGUAGES[0][0])
        for name, use in compiler.intel(source, options):
            add(stage, name, INTEL, use)
    return rows


def excesses(rows: list[dict[str, Any]]) -> list[str]:
    """A sentence for each limit that a kernel exceeds."""
    result = []
    for row in rows:
        private = max(PRIVATE_MAX, PRIVATE_LARGER.get(row["kernel"], 0))
        for name, most in (("private", private), ("local", LOCAL_MAX), ("registers", REGISTERS_MAX)):
            if row[name] > most:
                result.append(f"{row['kernel']} on {row['target']}: expected {name} <= {most}, found {row[name]}")
    return result


def main() -> None:
    """Compile, write the table, and end with status 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clang", default="clang-19")
    parser.add_argument("--library", type=Path, default=Path("/usr/lib/clc"), help="folder of libclc's .bc files")
    parser.add_argument("-o", "--out", type=Path, help="JSON file for the table")
    arguments = parser.parse_args()
    if shutil.which(arguments.clang) is None:
        sys.exit(f"--clang: expected Clang 19, found no {arguments.clang}; on Debian, apt install clang-19")
    if not arguments.library.is_dir():
        sys.exit(
            f"--library: expected libclc, found no {arguments.library}; install it (Debian: apt install libclc-19)"
        )
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Compiler(arguments.clang, arguments.library, Path(folder)))
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n")
    sys.exit("\n".join(excesses(rows)) or None)


if __name__ == "__main__":
    main()
