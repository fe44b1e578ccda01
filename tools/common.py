"""Options, progress and figures of the benchmarks."""

import argparse
import statistics
from collections.abc import Callable, Iterable

from mjstack.config import load_config
from mjstack.config.schema import Config
from mjstack.envs.buffers import Advance
from mjstack.errors import MjstackError
from mjstack.report.table import Console, Table

Work = Callable[[argparse.Namespace, Config, Advance], Iterable[Table]]


def make_parser(text: str | None) -> argparse.ArgumentParser:
    """A parser of overrides, to which a benchmark adds its options."""
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words = "as for run.py, such as robot=rebot nworld=1024 (default nworld=256)"
    parser.add_argument("overrides", nargs="*", help=words)
    parser.add_argument("--config-dir", help="a folder with more choices")
    return parser


def count(text: str) -> int:
    """The value of an option that is an integer of at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: expected an integer of at least 1")
    return value


def run(parser: argparse.ArgumentParser, work: Work) -> None:
    """Parse the command line, measure with a progress line, and print the tables."""
    args = parser.parse_intermixed_args()
    console = Console(soft_wrap=True)
    try:
        cfg = load_config(["nworld=256", *args.overrides], config_dir=args.config_dir)
        with console.status("preparing") as status:

            def advance(part: str, done: int, total: int) -> None:
                status.update(f"{part}: {done} of {total}")

            tables = list(work(args, cfg, advance))
    except MjstackError as error:
        parser.exit(error.exit_code, f"{parser.prog}: {error}\n")
    for table in tables:
        console.print(table.to_console())


def spread(values: list[float]) -> str:
    """Median and range of repetitions; "-" where there are none."""
    if not values:
        return "-"
    return f"{statistics.median(values):.4g} ({min(values):.4g} to {max(values):.4g})"
