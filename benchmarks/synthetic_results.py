"""Scaling of time and peak memory of reading a journal and writing the report.

    make synthetic   or   .venv/bin/python benchmarks/synthetic_results.py [CASES ...]

The synthetic journal has 20 solvers and 5 repeats; the report is written in all
formats. Each measurement runs in a separate process, so that its peak memory is known.
If chromium and playwright are installed (make browser), the script also measures the
times until the first paint of the page and until the end of loading.
"""

import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

SOLVERS, REPEATS = 20, 5
CASES = (10, 100, 1000)
FORMATS = ("html", "md", "tex", "csv", "parquet")
TIMES = """() => new Promise((done) =>
  requestAnimationFrame(() => setTimeout(() => done([
    performance.getEntriesByName("first-contentful-paint")[0]?.startTime,
    performance.getEntriesByType("navigation")[0].loadEventEnd]))))"""


def read(folder):
    """Read the journal in a folder; print number of records, CPU time, peak memory."""
    from mortarbench.harness.results.journal import read_journal

    start = process_time()
    records = read_journal(Path(folder))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{len(records):9} {process_time() - start:9.1f} {peak:9.0f}", end="")


def measure(folder):
    """Write the report on a folder; print CPU time, peak memory and page size."""
    from mortarbench.reports import write_report

    start = process_time()
    write_report(Path(folder), FORMATS)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    size = (Path(folder) / "report" / "index.html").stat().st_size / 1e6
    print(f"{process_time() - start:9.1f} {peak:9.0f} {size:9.1f}", end="")


def paint(folder):
    """Return the times to first paint and to the end of loading, in ms.

    Return None if chromium or playwright is not installed.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        return None
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        return None
    root = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=browser, args=root)
        page = chromium.new_page()
        page.goto((folder / "report" / "index.html").as_uri())
        times = page.evaluate(TIMES)
        chromium.close()
    return times


def main(cases):
    maker = Path(__file__).parents[1] / "tests/support/synthetic_results.py"
    print("             journal:            report:")
    print(
        "  records     CPU s  peak MiB     CPU s  peak MiB   page MB"
        "  first paint s  loaded s"
    )
    for count in cases:
        with TemporaryDirectory() as folder:
            make = [maker, folder, SOLVERS, count, REPEATS]
            subprocess.run([sys.executable, *map(str, make)], check=True)
            for part in ("--read", "--measure"):
                command = [sys.executable, __file__, part, folder]
                output = subprocess.check_output(command, text=True)
                print(output, end="", flush=True)
            times = paint(Path(folder))
            print("" if times is None else "".join(f"{t / 1e3:12.2f}" for t in times))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--read"]:
        read(sys.argv[2])
    elif sys.argv[1:2] == ["--measure"]:
        measure(sys.argv[2])
    else:
        main([int(a) for a in sys.argv[1:]] or CASES)
