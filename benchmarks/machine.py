"""What the figures were measured on."""

import os
import platform
import shutil
import subprocess
import textwrap
from importlib import metadata
from pathlib import Path

PACKAGES = ("hybridtrack", "numpy", "numba", "filterpy", "jax", "pyrecest")


def describe() -> list[str]:
    """CPU, cores, load and versions, as Markdown."""
    versions = [f"Python {platform.python_version()}"]
    for package in PACKAGES:
        try:
            versions.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            continue
    if compiler := shutil.which("g++"):
        version = subprocess.run(
            [compiler, "-dumpfullversion"], capture_output=True, text=True, check=True
        )
        versions.append(f"g++ {version.stdout.strip()}")
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return [
        f"{_cpu()}, {os.cpu_count()} cores{load}.",
        *textwrap.wrap(f"{', '.join(versions)}.", 80),
    ]


def _cpu() -> str:
    """Model, and the family that tells apart what goes by the same name."""
    file = Path("/proc/cpuinfo")
    if not file.exists():
        return platform.processor() or platform.machine()
    fields = dict(
        line.split(":", 1) for line in file.read_text().splitlines() if line.count(":") == 1
    )
    said = {key.strip(): value.strip() for key, value in fields.items()}
    vectors = "AVX-512" if "avx512f" in said.get("flags", "") else "no AVX-512"
    model = said.get("model name", platform.machine())
    return f"{model} (family {said.get('cpu family', '?')}, {vectors})"
