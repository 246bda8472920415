"""Write the reports of a benchmark: a page per suite or dataset, and a scores file per detector."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from kpbench.benchmark.run import BenchRun
from kpbench.files import make_folder
from kpbench.provenance import UNKNOWN_SOURCE, image_source
from kpbench.report.paper import PAPER
from kpbench.report.report import write_report
from kpbench.report.result_files import collect_provenance, encode_scores
from kpbench.report.score_tables import breakpoint_table, overview_table, paper_table
from kpbench.report.sections import Report, name_runs
from kpbench.report.tables import Table
from kpbench.writing import write_file


@dataclass(frozen=True)
class SuiteReport:
    """The results of all detectors on one suite or dataset.

    Attributes
    ----------
    suite : str
        Name of the suite or dataset.
    tables : tuple of Table
        The main metrics over all images, the paper's tables with rows for the detectors, and the breakpoints.
    page : Path
        The HTML report.
    scores_folder : Path
        Folder with one scores file per detector.

    Examples
    --------
    >>> import kpbench
    >>> from pathlib import Path
    >>> kpbench.SuiteReport("paper-v1", (), Path("paper-v1.html"), Path("scores/paper-v1")).suite
    'paper-v1'
    """

    suite: str
    tables: tuple[Table, ...]
    page: Path
    scores_folder: Path


def write_suite_reports(
    runs: Iterable[BenchRun], out: str | Path, *, command: Sequence[str] = ()
) -> tuple[SuiteReport, ...]:
    """Write a report per suite or dataset, and a scores file for each detector on it.

    Parameters
    ----------
    runs : iterable of BenchRun
        The result of :func:`bench` or :func:`bench_dataset`.
    out : str or Path
        Folder for ``SUITE.html``, ``SUITE.md`` and ``scores/SUITE/DETECTOR.json``.
    command : sequence of str
        The command line, for the provenance.

    Returns
    -------
    tuple of SuiteReport

    Raises
    ------
    DataError
        If a file cannot be written.

    Examples
    --------
    >>> import kpbench
    >>> suite = kpbench.SuiteConfig(kpbench.load_suite("paper-v1"), images=1, size_px=(203, 155), only=("blur",))
    >>> runs = kpbench.bench([suite], ["orb"], "bench", workers=1)
    >>> [report] = kpbench.write_suite_reports(runs, "bench")
    >>> report.page.as_posix(), report.tables[0].title
    ('bench/paper-v1.html', 'All images')
    """
    by_suite = groupby(runs, lambda run: run.suite)
    return tuple(_write_suite_report(suite, tuple(part), Path(out), command) for suite, part in by_suite)


def _write_suite_report(suite: str, runs: Sequence[BenchRun], out: Path, command: Sequence[str]) -> SuiteReport:
    dataset, scores = runs[0].dataset, tuple(name_runs([run.scores for run in runs]))
    source = image_source(dataset.config)
    title = ", ".join(filter(None, (suite, source)))
    provenance = collect_provenance(dataset, [run.predictions for run in runs], command)
    page = out / f"{suite}.html"
    for path in (page, page.with_suffix(".md")):
        write_report(path, Report(scores, dataset.config, provenance=provenance, title=title))
    folder = make_folder(out / "scores" / suite)
    for run in runs:
        provenance = collect_provenance(run.dataset, [run.predictions], command)
        name = f"{run.predictions.stem.rpartition('-')[0]}.json"
        write_file(folder / name, encode_scores(run.scores, provenance | {"config": run.dataset.config}))
    pairs = zip(runs, scores, strict=True)
    patches = [named for run, named in pairs if run.config is None or run.config.board is None]
    images = source or UNKNOWN_SOURCE
    tables = [
        paper_table(patches, PAPER[name], images) for run in patches[:1] for name in run.conditions if name in PAPER
    ]
    return SuiteReport(suite, (overview_table(scores), *tables, breakpoint_table(scores)), page, folder)
