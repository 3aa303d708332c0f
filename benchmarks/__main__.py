"""Run the benchmarks: ``python -m benchmarks [--quick] [--only NAME] [--gate] [--out FOLDER]``."""

import argparse
import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

from benchmarks import harness, pictures, suites  # noqa: E402 (after x64)

BASELINE = Path(__file__).parent / "baseline.json"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller sizes, under 3 minutes")
    names = parser.add_argument("--only", metavar="NAME", action="append", choices=suites.SUITES)
    names.help = "run this one alone (may be given again): " + ", ".join(suites.SUITES)
    parser.add_argument(
        "--gate", action="store_true", help="fail where a ratio is worse than in baseline.json"
    )
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"), help="folder to write")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    metrics = []
    for name in options.only or suites.SUITES:
        began = time.perf_counter()
        metrics += suites.SUITES[name](options.quick)
        print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    table = harness.as_markdown(metrics)
    print(table)
    (options.out / "benchmarks.json").write_text(harness.as_json(metrics) + "\n")
    (options.out / "table.md").write_text(table)
    for path in pictures.draw(suites.CURVES, options.out):
        print(f"wrote {path}", file=sys.stderr)
    if options.gate:
        worse = harness.gate(metrics, BASELINE.read_text())
        for line in worse:
            print(f"worse than the baseline: {line}", file=sys.stderr)
        return 1 if worse else 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
