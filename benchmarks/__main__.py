"""Run the benchmarks: ``python -m benchmarks [--quick] [--only NAME] [--gate] [--out FOLDER]``."""

import argparse
import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

from benchmarks import metrics, pictures  # noqa: E402 (after x64)
from benchmarks.suites import SUITES  # noqa: E402

BASELINE = Path(__file__).parent / "baseline.json"


def main() -> int:
    options = _options()
    options.out.mkdir(parents=True, exist_ok=True)
    found: list[metrics.Metric] = []
    curves = {}
    for name in options.only or SUITES:
        began = time.perf_counter()
        findings = SUITES[name](options.quick)
        found += findings.metrics
        curves |= findings.curves
        print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    table = metrics.as_markdown(found)
    print(table)
    (options.out / "benchmarks.json").write_text(metrics.as_json(found) + "\n")
    (options.out / "table.md").write_text(table)
    for path in pictures.draw(curves, options.out):
        print(f"wrote {path}", file=sys.stderr)
    worse = metrics.gate(found, BASELINE.read_text()) if options.gate else []
    for line in worse:
        print(f"worse than the baseline: {line}", file=sys.stderr)
    return 1 if worse else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller sizes, under 3 minutes")
    names = parser.add_argument("--only", metavar="NAME", action="append", choices=SUITES)
    names.help = "run this suite alone (may be given again): " + ", ".join(SUITES)
    parser.add_argument(
        "--gate", action="store_true", help="fail where a ratio is worse than in baseline.json"
    )
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"), help="folder to write")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
