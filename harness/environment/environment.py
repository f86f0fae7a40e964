"""Environment of a measurement: machine, versions, source, threads and BLAS.

The description is plain data. It contains no host names, user names or absolute paths,
so that result folders can be shared.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from mortarbench.harness.digest import hex_digest
from mortarbench.harness.limits import ONE_THREAD
from mortarbench.harness.registry import PluginFile

#: Packages whose versions may affect the measurements of all solvers.
PACKAGES = ("mortarbench", "numpy", "scipy", "scikit-sparse", "pandas")

THREAD_VARIABLES = (
    "OMP_NUM_THREADS", "OMP_THREAD_LIMIT", "OMP_DYNAMIC", "OMP_PROC_BIND", "OMP_PLACES",
    "OPENBLAS_NUM_THREADS", "OPENBLAS_CORETYPE", "GOTO_NUM_THREADS", "MKL_NUM_THREADS",
    "MKL_DYNAMIC", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS",
    "RAYON_NUM_THREADS",
)  # fmt: skip

#: owners of a BLAS that the code of mortarbench may use: the operating system, or the
#: wheel of a package
OWNERS = ("system", "numpy", "scipy", "scikit_sparse")

VOLATILE = ("now",)  #: keys of an environment that its digest excludes

#: folders of a checkout that contain code
_CODE = ("harness", "problems", "solvers", "reports", "mortarbench")
_CPU = Path("/sys/devices/system/cpu")


def capture(
    plugins: Iterable[str | Path | PluginFile] = (), packages: Iterable[str] = ()
) -> dict[str, Any]:
    """Describe the environment of this process as nested plain data.

    Values that cannot be read are None. The variables are those of a worker.

    plugins : plug-in files; digests of their code are included
    packages : packages of solvers whose versions are included
    """
    import psutil
    from threadpoolctl import threadpool_info

    # import these modules, since threadpoolctl finds only loaded libraries
    for module in ("numpy", "scipy.linalg", "sksparse.cholmod"):
        with suppress(ImportError):
            import_module(module)
    memory = psutil.virtual_memory().total
    governors = {_read(f) for f in _CPU.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    variables = os.environ | ONE_THREAD
    return {
        "machine": {
            "cpu": next(iter(_cpuinfo("model name")), None),
            "usable_cores": len(os.sched_getaffinity(0)),
            "cpu_limit": _cpu_limit(),
            "memory_mib": memory >> 20,
            "system": platform.system(),
            "kernel": platform.release(),
            "governor": ", ".join(sorted(governors - {""})) or None,
            "turbo": _turbo(),
            "smt": {"1": True, "0": False}.get(_read(_CPU / "smt/active")),
        },
        "versions": {"python": platform.python_version()}
        | {name: _version(name) for name in (*PACKAGES, *packages)},
        "source": source(Path(__file__).resolve().parents[2]),
        "plugins": _plugins(map(PluginFile.of, plugins)),
        "threads": {k: variables[k] for k in THREAD_VARIABLES if k in variables},
        "blas": dict(sorted(filter(None, map(_blas, threadpool_info())))),
        "now": {
            "time": datetime.now(UTC).isoformat(timespec="seconds"),
            "load": os.getloadavg()[0],
        },
    }


def packages_of(environment: Mapping[str, Any]) -> list[str]:
    """Return the names of the solvers' packages in the versions of an environment."""
    return [n for n in environment["versions"] if n not in ("python", *PACKAGES)]


def digest(environment: Mapping[str, Any]) -> str:
    """Return 12 hexadecimal digits that identify an environment.

    Time, load and free memory do not affect the digest. Measured times may be compared
    if the digests of their environments are equal.
    """
    lasting = {k: v for k, v in environment.items() if k not in VOLATILE}
    canonical = json.dumps(lasting, sort_keys=True, separators=(",", ":"))
    return hex_digest([canonical.encode()])


def source(root: Path) -> dict[str, Any] | None:
    """Identify the code of a checkout; return None if `root` is not a checkout.

    Returns
    -------
    a dict with
    commit : full hash of the commit
    dirty : True if the code differs from the commit
    changes : digest, 12 hexadecimal digits, of the differences and of new Python files;
        None if the code does not differ

    """

    def git(*arguments: str) -> bytes:
        command = ("git", "-C", str(root), *arguments)
        return subprocess.run(command, capture_output=True, check=True).stdout

    if not (root / ".git").exists():
        return None
    try:
        status = git("status", "--porcelain=v2", "--branch", "--", *_CODE).decode()
        commit = status.partition("\n")[0].rpartition(" ")[2]
        if all(line.startswith("#") for line in status.splitlines()):
            return {"commit": commit, "dirty": False, "changes": None}
        # an external diff tool configured by the user would change the digest
        changes = [git("diff", "--no-ext-diff", "HEAD", "--", *_CODE)]
        listed = git("ls-files", "-z", "--others", "--exclude-standard", "--", *_CODE)
        for name in sorted(listed.split(b"\0")):
            if name.endswith(b".py"):
                changes += [name, b"\0", (root / os.fsdecode(name)).read_bytes()]
    except (OSError, subprocess.CalledProcessError):
        return None
    return {"commit": commit, "dirty": True, "changes": hex_digest(changes)}


def _blas(info: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return name and version of a BLAS in an entry of threadpoolctl, or None.

    None is returned for other libraries, and for those that a notebook or a plug-in
    has loaded. The path of the library is replaced by its owner.
    """
    bundled = re.search(r"/(\w+)\.libs/", info["filepath"])
    owner = bundled[1] if bundled else "system"
    if info["user_api"] != "blas" or owner not in OWNERS:
        return None
    parts = (info["version"], info.get("threading_layer"), info.get("architecture"))
    return f"{info['prefix']} ({owner})", " ".join(filter(None, parts))


def _version(package: str) -> str | None:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _plugins(files: Iterable[PluginFile]) -> dict[str, str]:
    """Return digests of plug-in code, by plug-in name.

    If several files have the same name, the result contains one digest of these files.
    """
    contents: dict[str, list[bytes]] = defaultdict(list)
    for file in files:
        contents[file.name].extend(file.content())
    return {name: hex_digest(content) for name, content in contents.items()}


def _cpu_limit() -> float | None:
    """Return the container's CPU limit, in cores; None if unlimited or unknown."""
    limit = re.match(r"(\d+) (\d+)", _read(Path("/sys/fs/cgroup/cpu.max")))
    return int(limit[1]) / int(limit[2]) if limit else None


def _turbo() -> bool | None:
    if no_turbo := _read(_CPU / "intel_pstate/no_turbo"):
        return no_turbo == "0"
    boost = _read(_CPU / "cpufreq/boost")
    return boost == "1" if boost else None


def _cpuinfo(key: str) -> list[str]:
    return re.findall(rf"^{key}\s*: (.*)$", _read(Path("/proc/cpuinfo")), re.M)


def _read(path: Path) -> str:
    """Return the text of a small system file; "" if it cannot be read."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
