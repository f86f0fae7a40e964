"""What a measurement depends on besides the code: machine, versions, threads, BLAS.

Everything is plain data without host names, user names or absolute paths, so that a
result folder can be handed to others.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_info

from mortarbench.harness.digest import hex_digest
from mortarbench.harness.registry import PluginFile

#: that measurements rest on, whichever solvers there are
PACKAGES = ("mortarbench", "numpy", "scipy", "scikit-sparse", "pandas")

THREAD_VARIABLES = (
    "OMP_NUM_THREADS", "OMP_THREAD_LIMIT", "OMP_DYNAMIC", "OMP_PROC_BIND", "OMP_PLACES",
    "OPENBLAS_NUM_THREADS", "OPENBLAS_CORETYPE", "GOTO_NUM_THREADS", "MKL_NUM_THREADS",
    "MKL_DYNAMIC", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS",
    "RAYON_NUM_THREADS",
)  # fmt: skip

#: libraries that bring a BLAS; the plain name comes last because shells bear it too
BLAS_LIBRARIES = (
    ("libopenblas", "OpenBLAS"), ("libmkl", "MKL"), ("libblis", "BLIS"),
    ("libflexiblas", "FlexiBLAS"), ("libatlas", "ATLAS"), ("libsatlas", "ATLAS"),
    ("libblas", "reference BLAS"),
)  # fmt: skip
#: whose thread pools what we measure with calls
OWNERS = ("system", "numpy", "scipy", "scikit_sparse")
CHOLMOD_OWNERS = ("system", "scikit_sparse")  #: whose libraries CHOLMOD may call

VOLATILE = ("now",)  #: the parts of an environment that its digest leaves out

_CODE = ("harness", "problems", "solvers", "reports", "mortarbench")  #: of a checkout
_CPU = Path("/sys/devices/system/cpu")
_CGROUP = Path("/sys/fs/cgroup")


def capture(
    plugins: Iterable[str | Path | PluginFile] = (), packages: Iterable[str] = ()
) -> dict[str, Any]:
    """Describe this process: nested plain data, None where something is unreadable.

    The threads are those of the calling process: for a worker's, use `capture_in`.

    plugins : files whose code is measured along with ours
    packages : of solvers, whose versions belong to it
    """
    # Only libraries in memory can be asked for their threads.
    for module in ("numpy", "scipy.linalg", "sksparse.cholmod"):
        with suppress(ImportError):
            import_module(module)
    # others may be loaded, too: plug-ins' libraries, or those of a notebook
    pools = sorted(
        (p for p in map(_pool, threadpool_info()) if p["owner"] in OWNERS),
        key=lambda p: (p["library"], p["owner"]),
    )
    mapped = mapped_libraries()
    cores = set(zip(_cpuinfo("physical id"), _cpuinfo("core id"), strict=False))
    governors = {_read(f) for f in _CPU.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    governors.discard("")
    return {
        "machine": {
            "cpu": next(iter(_cpuinfo("model name")), None),
            "physical_cores": len(cores) or None,
            "logical_cores": os.cpu_count(),
            "usable_cores": len(os.sched_getaffinity(0)),
            "cpu_limit": _cpu_limit(),
            "memory_mib": _meminfo("MemTotal"),
            "architecture": platform.machine(),
            "system": platform.system(),
            "kernel": platform.release(),
            "libc": " ".join(platform.libc_ver()).strip() or None,
            "virtual": "hypervisor" in " ".join(_cpuinfo("flags")).split(),
            "governor": ", ".join(sorted(governors)) or None,  # that of each CPU
            "turbo": _turbo(),
            "smt": {"1": True, "0": False}.get(_read(_CPU / "smt/active")),
        },
        "versions": {"python": platform.python_version()}
        | {name: _version(name) for name in (*PACKAGES, *packages)},
        "source": source(Path(__file__).resolve().parents[2]),
        "plugins": _plugins(map(PluginFile.of, plugins)),
        "threads": {
            "variables": {
                k: os.environ[k] for k in THREAD_VARIABLES if k in os.environ
            },
            "pools": pools,
        },
        "cholmod": {
            "version": cholmod_version(mapped),
            "blas": system_blas(mapped, pools),
        },
        "now": {
            "time": datetime.now(UTC).isoformat(timespec="seconds"),
            "load": os.getloadavg()[0],
            "available_memory_mib": _meminfo("MemAvailable"),
        },
    }


def capture_in(
    variables: Mapping[str, str],
    plugins: Iterable[str | Path | PluginFile] = (),
    packages: Iterable[str] = (),
) -> dict[str, Any]:
    """Describe a process that is started with some variables set, as workers are.

    Libraries read their thread variables only once, when they are loaded.
    """
    program = (
        "import json, sys, mortarbench.harness.environment.environment as e; "
        "plugins, packages = map(json.loads, sys.argv[1:]); "
        "print(json.dumps(e.capture(plugins, packages)))"
    )
    given = ([*map(str, plugins)], [*packages])
    done = subprocess.run(
        [sys.executable, "-P", "-c", program, *map(json.dumps, given)],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=True,
    )
    captured: dict[str, Any] = json.loads(done.stdout)
    return captured


def packages_of(environment: Mapping[str, Any]) -> list[str]:
    """Name the packages of solvers whose versions an environment has."""
    known = ("python", *PACKAGES)
    return [name for name in environment.get("versions", ()) if name not in known]


def digest(environment: Mapping[str, Any]) -> str:
    """Name the environment by 12 hex digits; load, free memory and time do not count.

    Equal digests mean that times may be compared.
    """
    lasting = {k: v for k, v in environment.items() if k not in VOLATILE}
    canonical = json.dumps(lasting, sort_keys=True, separators=(",", ":"))
    return hex_digest([canonical.encode()])


def source(root: Path) -> dict[str, Any] | None:
    """Name the commit of a checkout, and the changes since then by a digest.

    dirty : whether code differs from the commit
    changes : 12 hex digits of what differs and of new Python files; None if clean
    """

    def git(*arguments: str) -> bytes:
        command = ("git", "-C", str(root), *arguments)
        return subprocess.run(command, capture_output=True, check=True).stdout

    if not (root / ".git").exists():
        return None
    try:
        commit = git("rev-parse", "HEAD").decode().strip()
        if not git("status", "--porcelain", "--", *_CODE):
            return {"commit": commit, "dirty": False, "changes": None}
        changes = [git("diff", "--no-ext-diff", "HEAD", "--", *_CODE)]
        listed = git("ls-files", "-z", "--others", "--exclude-standard", "--", *_CODE)
        for name in sorted(listed.split(b"\0")):
            if name.endswith(b".py"):
                changes += [name, b"\0", (root / os.fsdecode(name)).read_bytes()]
    except (OSError, subprocess.CalledProcessError):
        return None
    return {"commit": commit, "dirty": True, "changes": hex_digest(changes)}


def mapped_libraries() -> list[str]:
    """List the files that this process has mapped; empty where the system won't say."""
    lines = _read(Path("/proc/self/maps")).splitlines()
    return sorted({line.split(maxsplit=5)[5] for line in lines if " /" in line})


def system_blas(
    mapped: Iterable[str], pools: Iterable[Mapping[str, Any]]
) -> str | None:
    """Name the BLAS behind CHOLMOD, e.g. "OpenBLAS 0.3.21 (pthreads)".

    Wheels bring a BLAS of their own, which CHOLMOD does not call: whatever lies in
    site-packages is left out, unless it is scikit-sparse's own. A system library named
    libblas is the reference BLAS unless an optimised one stands behind it: Debian's
    alternatives make libblas.so.3 a thin shell around the real library.

    mapped : absolute paths, as in /proc/self/maps
    pools : as under threads in `capture`
    """
    names = {Path(file).name for file in mapped if not _in_foreign_wheel(file)}
    for stem, title in BLAS_LIBRARIES:
        if any(name.startswith(stem) for name in names):
            for pool in pools:
                if pool["library"].startswith(stem) and pool["owner"] in CHOLMOD_OWNERS:
                    layer = f"({pool['layer']})" if pool["layer"] else None
                    return " ".join(filter(None, (title, pool["version"], layer)))
            return title
    return None


def cholmod_version(mapped: Iterable[str]) -> str | None:
    """Read the version of CHOLMOD off the name of its library."""
    for path in mapped:
        if found := re.search(r"/libcholmod[^/]*\.so\.([\d.]+)$", path):
            return found[1]
    return None


def _in_foreign_wheel(path: str) -> bool:
    found = re.search(r"/(?:site|dist)-packages/([^/]+)", path)
    return found is not None and not found[1].startswith(("scikit_sparse", "sksparse"))


def _pool(info: Mapping[str, Any]) -> dict[str, Any]:
    """Keep of a threadpoolctl entry what is no path."""
    bundled = re.search(r"/(\w+)\.libs/", info["filepath"])
    return {
        "library": info["prefix"],
        "owner": bundled[1] if bundled else "system",
        "version": info["version"],
        "architecture": info.get("architecture"),
        "layer": info.get("threading_layer"),
        "threads": info["num_threads"],
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _plugins(files: Iterable[PluginFile]) -> dict[str, str]:
    """Name the code of plug-ins by 12 hex digits; those of one name are as one."""
    contents: dict[str, list[bytes]] = defaultdict(list)
    for file in files:
        contents[file.name].extend(file.content())
    return {name: hex_digest(content) for name, content in contents.items()}


def _cpu_limit() -> float | None:
    """Read the container's share of processor time, in cores; None without a limit."""
    quota, period = ([*_read(_CGROUP / "cpu.max").split(), "", ""])[:2]
    if not quota:  # the older layout of control groups
        quota = _read(_CGROUP / "cpu/cpu.cfs_quota_us")
        period = _read(_CGROUP / "cpu/cpu.cfs_period_us")
    return int(quota) / int(period) if quota.isdigit() and period.isdigit() else None


def _turbo() -> bool | None:
    if no_turbo := _read(_CPU / "intel_pstate/no_turbo"):
        return no_turbo == "0"
    boost = _read(_CPU / "cpufreq/boost")
    return boost == "1" if boost else None


def _meminfo(key: str) -> int | None:
    """Read one entry of /proc/meminfo, in MiB."""
    found = re.search(rf"^{key}:\s+(\d+) kB", _read(Path("/proc/meminfo")), re.M)
    return int(found[1]) // 1024 if found else None


def _cpuinfo(key: str) -> list[str]:
    return re.findall(rf"^{key}\s*: (.*)$", _read(Path("/proc/cpuinfo")), re.M)


def _read(path: Path) -> str:
    """Read a small system file; empty where there is none or it may not be read."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
