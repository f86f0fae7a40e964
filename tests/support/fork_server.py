"""Server that starts the processes of runs as forks with libraries loaded.

A new interpreter needs half a second of CPU time for imports, more than the work of
most tests. The server therefore forks a process instead. Like any process, the fork has
its own memory, signals and exit code, and the requested files, environment and limits.
Its parent is the small parent of `harness.processes.parent`, whose parent is the
requesting process. /proc shows the command line and environment of the fork, see
proc(5). Only the start of an interpreter is left out; tests of this start launch
processes in the ordinary way.

If the module is run as a program with a socket and modules to import, it acts as the
server.
"""

import atexit
import gc
import json
import os
import resource
import runpy
import signal
import socket
import subprocess
import sys
import time
import traceback
from contextlib import suppress
from ctypes import CDLL, memmove, memset
from functools import cache
from importlib import import_module
from pathlib import Path
from threading import Lock
from types import ModuleType

from mortarbench.harness.limits import ONE_THREAD
from mortarbench.harness.processes import parent

LONGEST = 2**20  #: maximum length of a request, bytes
LIMITS = [getattr(resource, name) for name in dir(resource) if name[:7] == "RLIMIT_"]
PR_SET_CHILD_SUBREAPER = 36  # prctl(2)
#: fields of /proc/PID/stat with the addresses of arguments and environment
ARGUMENTS, ENVIRONMENT = 48, 50
#: padding that reserves memory for longer arguments and environments of forks
ROOM = 2**16 * " "

#: modules loaded for plug-ins, which start as ``python -P FILE``
PLUGINS = ("mortarbench.cli.main", "mortarbench.processes")
#: modules loaded for ``python -P -m mortarbench``, with its own solvers and cases
OURS = (
    *PLUGINS, "mortarbench.solvers.smalbe.solver", "mortarbench.problems.fem.kernels",
    "mortarbench.solvers.reference.solve", "scipy.optimize", "sksparse.cholmod",
)  # fmt: skip

#: modules loaded for ``python -P -m dask``, the processes of a cluster
CLUSTER = (
    *PLUGINS, "dask.__main__", "distributed.cli.dask_scheduler",
    "distributed.cli.dask_worker", "mortarbench.harness.running.cluster",
)  # fmt: skip

#: code that makes another program, such as a notebook kernel, start workers as forks
INSTALL = (
    f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); "
    "import fork_server; from mortarbench.harness.processes import supervisor; "
    "supervisor.subprocess = fork_server.Forks()\n"
)


class Forks:
    """Replacement of the module `subprocess` in `harness.processes.supervisor`."""

    DEVNULL = subprocess.DEVNULL
    TimeoutExpired = subprocess.TimeoutExpired

    def __init__(self, servers=()):
        self._env = os.environ | ONE_THREAD | {"ROOM": ROOM}
        self._servers = dict(servers)
        self._lock = Lock()

    def Popen(self, args, **how):
        """Start a worker below its small parent; start other programs normally."""
        own = [sys.executable, "-I", "-S", parent.__file__]
        if args[:4] != own or args[8:10] != [sys.executable, "-P"] or args[10] == "-c":
            return subprocess.Popen(args, **how)
        modules = OURS if args[10] == "-m" else PLUGINS
        return Forked(self._server(modules), args[4:], **how)

    def dask(self, arguments, env, serves):
        """Start ``python -m dask`` with input from and output to /dev/null.

        serves : True if the started process also starts its workers as forks
        """
        request = {
            "program": [sys.executable, "-P", "-m", "dask", *arguments],
            "serves": serves, "env": dict(env),
        }  # fmt: skip
        with open(os.devnull, "r+b") as null:
            return Program(self._server(CLUSTER).start(request, 3 * [null.fileno()]))

    def _server(self, modules):
        with self._lock:
            if modules not in self._servers:
                self._servers[modules] = Server.of_its_own(modules, self._env)
            return self._servers[modules]

    def close(self):
        for server in self._servers.values():
            server.close()


class Server:
    """Connection to a forked or started process that has loaded some modules."""

    def __init__(self, ours, process):
        self._ours = ours
        self._process = process

    @classmethod
    def of_its_own(cls, modules, env):
        """Start an interpreter that loads these modules."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            fd = theirs.fileno()
            command = [sys.executable, "-P", __file__, str(fd), ROOM, *modules]
            return cls(ours, subprocess.Popen(command, pass_fds=[fd], env=env))

    @classmethod
    def as_fork(cls):
        """Fork this process, which has loaded the modules and has a single thread."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if (process := os.fork()) == 0:
            ours.close()
            serve(theirs)
            os._exit(0)
        theirs.close()
        return cls(ours, Program(process))

    def close(self):
        self._ours.close()
        self._process.wait()

    def start(self, request, fds):
        """Request a fork, adopt it, and return its process ID."""
        request |= {
            "cwd": os.getcwd(),
            "cpus": sorted(os.sched_getaffinity(0)),
            "limits": [resource.getrlimit(limit) for limit in LIMITS],
        }
        adopt(True)
        try:
            socket.send_fds(self._ours, [json.dumps(request).encode()], fds)
            return int(self._ours.recv(LONGEST))
        finally:
            adopt(False)


class Program:
    """The part of `subprocess.Popen` that callers use."""

    def __init__(self, pid):
        self.pid = pid
        self.returncode = None

    def poll(self):
        if self.returncode is None:
            ended, status = os.waitpid(self.pid, os.WNOHANG)
            if ended:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout=float("inf")):
        deadline = time.monotonic() + timeout
        while self.poll() is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("a fork", timeout)
            time.sleep(0.001)
        return self.returncode

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self):
        self.send_signal(signal.SIGTERM)

    def kill(self):
        self.send_signal(signal.SIGKILL)


class Forked(Program):
    """A forked worker below a small parent, with the interface that supervisors use."""

    def __init__(self, server, arguments, *, env, stdin, stdout, stderr, **how):
        assert stdin == subprocess.DEVNULL
        assert how.pop("start_new_session")
        assert list(how) == ["pass_fds"]
        assert list(map(str, how["pass_fds"])) == arguments[2:4]
        with open(os.devnull, "rb") as null:
            fds = [null.fileno(), stdout.fileno(), stderr.fileno(), *how["pass_fds"]]
            request = {"arguments": arguments, "env": dict(env)}
            super().__init__(server.start(request, fds))


def adopt(orphans):
    """Start or stop the adoption of orphaned descendants.

    orphans : True to start, False to stop
    """
    CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, int(orphans), 0, 0, 0)


def serve(asked):
    """Fork a process for each request, as an orphan that the requester adopts."""
    while True:
        message, fds, _, _ = socket.recv_fds(asked, LONGEST, 5)
        if not message:
            return
        request = json.loads(message)
        _, *program = request.get("program") or request["arguments"][4:]
        if program[1] != "-m":
            # the fork reports these errors
            with suppress(OSError, SyntaxError, ValueError):
                code_of(program[1])
        reader, writer = os.pipe()
        if (between := os.fork()) == 0:
            if child := os.fork():
                os.write(writer, str(child).encode())
                os._exit(0)
            for fd in (reader, writer, asked.detach()):
                os.close(fd)
            become(request, fds)
        os.waitpid(between, 0)  # from here on the child is an orphan
        asked.send(os.read(reader, 20))
        for fd in (reader, writer, *fds):
            os.close(fd)


def become(request, fds):
    """Run the requested program, or the small parent that starts this program."""
    os.setsid()
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    show(ENVIRONMENT, [f"{name}={value}" for name, value in request["env"].items()])
    os.sched_setaffinity(0, request["cpus"])
    for limit, values in zip(LIMITS, request["limits"], strict=True):
        resource.setrlimit(limit, values)
    for fd, at in zip(fds[:3], (0, 1, 2), strict=True):
        os.dup2(fd, at)
        os.close(fd)
    if "program" in request:
        sys.modules["dask"].config.refresh()  # read the new environment
        if request["serves"]:
            supervisor = sys.modules["mortarbench.harness.processes.supervisor"]
            supervisor.subprocess = Forks({PLUGINS: Server.as_fork()})
        run(None, request["program"])
    run_id, cpu, _, _, *command = request["arguments"]
    # the process of the run adopts this process
    while os.getppid() != int(run_id) and Path(f"/proc/{run_id}").exists():
        time.sleep(0.001)
    arguments = [run_id, cpu, *map(str, fds[3:]), *command]
    show(ARGUMENTS, [sys.executable, "-I", "-S", parent.__file__, *arguments])
    os.execvp = run
    parent.main(arguments)


def show(field, texts):
    """Set the arguments or environment of this process in /proc, like execve(2)."""
    stat = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    start, end = map(int, stat[field - 3 : field - 1])
    block = b"".join(os.fsencode(text) + b"\0" for text in texts)
    assert len(block) <= end - start, "longer than the memory reserved by `ROOM`"
    memset(start, 0, end - start)
    memmove(start, block, len(block))


def run(_, command):
    """Run a command line ``-P FILE ARGUMENT…`` or ``-P -m MODULE ARGUMENT…``."""
    show(ARGUMENTS, command)
    sys.argv = command[2:]
    try:
        if sys.argv[0] == "-m":
            sys.argv = sys.argv[1:]
            runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
        else:
            run_file(sys.argv[0])
    except OSError:  # the caller would attribute the error to execvp
        traceback.print_exc()
        sys.exit(1)
    except SystemExit as end:
        if end.code:
            raise
    end_well()


def run_file(path):
    """Run the program in a file like `runpy.run_path`, compiling it once."""
    main = ModuleType("__main__")
    main.__file__, main.__cached__ = path, None
    sys.modules["__main__"] = main
    exec(code_of(path), vars(main))


def code_of(path):
    """Compile a file if it has changed since the last compilation."""
    status = os.stat(path)
    return compiled(path, status.st_mtime_ns, status.st_size, status.st_ino)


@cache
def compiled(path, *_):
    return compile(Path(path).read_bytes(), path, "exec")


def end_well():
    """Exit without destructors, which would write to shared pages and thus
    copy them.
    """
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    _, own, _room, *loaded = sys.argv
    for module in loaded:
        import_module(module)
    gc.freeze()  # garbage collections would write to pages and end their sharing
    serve(socket.socket(fileno=int(own)))
