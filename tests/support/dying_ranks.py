"""Ranks that end in a known order, to test which rank `launch` reports as the first.

``dying_ranks.py COUNT TRIALS SEED`` launches COUNT ranks in each trial. One of them
exits, or is killed, possibly after printing a line that resembles our messages or 64
MiB of output.
The other ranks either exit as soon as they notice this, or continue. In some trials,
the parent process of the first rank is also killed. The program prints, as JSON, the
trials in which `launch` named a wrong rank.

The module imports only os and sys at the top, so that ranks start in milliseconds.
"""

import os
import sys

ENDINGS = ("killed", "exits 0", "exits 3", "prints", "flooding", "with its parent")
SIGKILL = 9


def be_rank(first, way, count, follow, folder):
    """End as the first rank, or after it; ranks exchange process IDs in files."""
    rank = int(os.environ["PMI_RANK"])
    with open(f"{folder}/{rank}.new", "w") as file:
        file.write(str(os.getpid()))
    os.rename(f"{folder}/{rank}.new", f"{folder}/{rank}")
    import select

    numbers = {}
    while len(numbers) < count:
        for other in range(count):
            if other not in numbers and os.path.exists(f"{folder}/{other}"):
                with open(f"{folder}/{other}") as file:
                    numbers[other] = int(file.read())
        select.select([], [], [], 0.001)
    if rank != first:
        seen = os.pidfd_open(numbers[first])
        with open(f"{folder}/{rank}.sees", "w"):
            pass
        select.select([seen] if follow else [], [], [], 30.0)
        os._exit(3)
    while sum(name.endswith(".sees") for name in os.listdir(folder)) < count - 1:
        select.select([], [], [], 0.001)
    die(way)


def die(way):
    if way == "exits 0":
        os._exit(0)
    if way == "exits 3":
        os._exit(3)
    if way == "prints":
        os.write(2, b"rank 7 of 9 ranks ended: exit code 5\nrank deficient by 3\n")
    if way == "flooding":
        for _ in range(64):
            os.write(1, b"x" * 2**20)
    if way == "with its parent":
        os.kill(os.getppid(), SIGKILL)
    os.kill(os.getpid(), SIGKILL)


def main(count, trials, seed):
    import json
    import random
    import tempfile
    from contextlib import redirect_stderr
    from io import StringIO

    from mortarbench.harness.processes.ranks import launch

    wrong, rng = [], random.Random(seed)
    for trial in range(trials):
        first, way = rng.randrange(count), ENDINGS[trial % len(ENDINGS)]
        follow = rng.random() < 0.5
        requests, replies = os.pipe(), os.pipe()
        with tempfile.TemporaryDirectory() as folder:
            command = [
                sys.executable, "-S", __file__, "rank", str(first), way, str(count),
                "follow" * follow, folder, str(requests[0]), str(replies[1]),
            ]  # fmt: skip
            with redirect_stderr(StringIO()) as said:
                launch(count, command)
        os.close(requests[1])
        os.close(replies[0])
        last = said.getvalue().splitlines()[-1]
        ended = {
            "exits 0": "exit code 0", "exits 3": "exit code 3",
            "with its parent": "",
        }.get(way, "Killed")  # fmt: skip
        if not last.startswith(f"rank {first} of {count} ranks ended: {ended}"):
            wrong.append([first, way, follow, last])
    print(json.dumps(wrong))


if __name__ == "__main__":
    if sys.argv[1] == "rank":
        be_rank(int(sys.argv[2]), sys.argv[3], int(sys.argv[4]), *sys.argv[5:7])
    else:
        main(*map(int, sys.argv[1:4]))
