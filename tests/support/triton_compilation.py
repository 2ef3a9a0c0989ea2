"""Compile Triton kernels for GPUs that need not be there, such as those of sm_80:
`python -m tests.support.triton_compilation 80 < launches.json`.

A process of its own, because Triton either interprets or compiles the kernels of a process. Prints a list of
`CompiledKernel` as JSON.
"""

import json
import re
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path

POINTERS = {"torch.float32": "*fp32", "torch.int32": "*i32", "torch.int64": "*i64"}


@dataclass(frozen=True)
class Launch:
    """How an operator launched a kernel: types of its arguments, and constants by name."""

    module: str
    name: str
    types: tuple[str, ...]
    constants: tuple[tuple[str, int], ...]
    warps: int


@dataclass(frozen=True)
class CompiledKernel:
    """What came out of the compiler."""

    launch: Launch
    architecture: int
    registers: int
    spilled_bytes: int
    barriers: int
    atomics: int


def launch_of(kernel, arguments: tuple, options: dict) -> Launch:
    """Describe a launch of an interpreted kernel."""
    constants = {name: int(value) for name, value in options.items() if name in kernel.arg_names}
    types = []
    for argument in arguments:
        if hasattr(argument, "data_ptr"):
            types.append(POINTERS[str(argument.dtype)])
        else:
            types.append("i32" if isinstance(argument, int) else "fp32")
    return Launch(
        kernel.fn.__module__,
        kernel.fn.__name__,
        tuple(types),
        tuple(sorted(constants.items())),
        options.get("num_warps", 4),
    )


def compiled(launch: Launch, architecture: int) -> CompiledKernel:
    """Compile one launch to a cubin and read its resources."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    kernel = getattr(import_module(launch.module), launch.name)
    constants = dict(launch.constants)
    names = [name for name in kernel.arg_names if name not in constants]
    signature = dict(zip(names, launch.types, strict=True)) | dict.fromkeys(constants, "constexpr")
    # What torch allocates is aligned, which a launch would find out.
    aligned = {
        (i,): [["tt.divisibility", 16]]
        for i, name in enumerate(kernel.arg_names)
        if str(signature[name]).startswith("*")
    }
    source = ASTSource(
        kernel, signature, {(kernel.arg_names.index(name),): value for name, value in constants.items()}, aligned
    )
    result = triton.compile(source, GPUTarget("cuda", architecture, 32), {"num_warps": launch.warps})
    usage = _resource_usage(Path(triton.__file__).parent, result.asm["cubin"])
    assembly = result.asm["ptx"]
    return CompiledKernel(
        launch,
        architecture,
        registers=int(re.search(r"REG:(\d+)", usage)[1]),
        spilled_bytes=int(re.search(r"STACK:(\d+)", usage)[1]) + int(re.search(r"LOCAL:(\d+)", usage)[1]),
        barriers=len(re.findall(r"\bbar(?:rier)?\.", assembly)),
        atomics=len(re.findall(r"\b(?:atom|red)\.", assembly)),
    )


def _resource_usage(triton_folder: Path, cubin: bytes) -> str:
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        tool = triton_folder / "backends" / "nvidia" / "bin" / "cuobjdump"
        return subprocess.run([tool, "-res-usage", file.name], check=True, capture_output=True, text=True).stdout


def main() -> None:
    """Compile what standard input lists for the architecture that the command names."""
    launches = [Launch(**{**launch, "types": tuple(launch["types"])}) for launch in json.load(sys.stdin)]
    results = [asdict(compiled(launch, int(sys.argv[1]))) for launch in launches]
    json.dump(results, sys.stdout)


if __name__ == "__main__":
    main()
