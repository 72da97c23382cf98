"""Sphinx directives that generate parts of pages from the package, so that both always agree.

``{constants}``: table of clsplat/constants.py.
``{config} NAME``: table of a dataclass of clsplat/config.py.
``{command} NAME``: output of ``clsplat NAME --help-all``.
``{presets}``: table of the settings of each preset.
``{bench_kernels} FILE [WORKLOAD | model]``: results of ``clsplat bench kernels -o FILE``, the stages of one workload,
or the model of the time.
``{bench_knobs} FILE``: table of ``clsplat bench knobs -o FILE``.
``{bench_viewer} FILE``: table of ``clsplat bench viewer -o FILE``.
``{bench_stability} FILE``: rows and charts that ``make bench-stability`` wrote to the folder of FILE.
``{bench_quality} FILE [COST]``: environment of the records of ``clsplat bench quality`` in FILE, or charts and table
of one cost.
``{bench_captures} FILE [captures]``: means and rotation of the records of ``clsplat bench captures`` in FILE, or the
table of all captures.
``{published_quality}``: chart and table of the original paper.
"""

import ast
import contextlib
import dataclasses
import inspect
import io
import json
import os
import re
import typing
from pathlib import Path
from types import ModuleType
from typing import Any

from docutils import nodes
from matplotlib.figure import Figure
from scene_experiments import ALL_EXPERIMENTS
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from clsplat import cli, config, constants
from clsplat.bench import captures_report, charts, quality_summary, results
from clsplat.bench import kernel_report as report
from clsplat.bench.frame_rates import frames_text
from clsplat.bench.knob_report import knobs_text
from clsplat.bench.stability import stability_report as stability
from clsplat.bench.time_report import model_text
from clsplat.ranges import rule_of
from clsplat.training import presets

HEADER_RULE = "|---"


def _docstring(statement: ast.stmt | None) -> str | None:
    """Text of a string statement, such as the docstring of a constant, on one line."""
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
        if isinstance(statement.value.value, str):
            return " ".join(statement.value.value.split())
    return None


def _prose(text: str) -> str:
    """Convert the plain text of a docstring to Markdown: everything except code spans is escaped."""
    parts = re.split(r"(``.+?``|`.+?`)", text)
    return "".join(p if i % 2 else re.sub(r"([\\*_<>|\[\]$])", r"\\\1", p) for i, p in enumerate(parts))


def _code(text: str) -> str:
    return "`" + text.replace("|", r"\|") + "`"


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(f"{v:.5f}" for v in value)
    return repr(value) if isinstance(value, int) else f"{value:.9g}"


def constants_table() -> str:
    """Markdown table of the public constants. Constants that share a docstring share a row."""
    body = ast.parse(inspect.getsource(constants)).body
    rows, names = [_row("constant", "value", "reason and source"), HEADER_RULE * 3 + "|"], []
    for statement, following in zip(body, [*body[1:], None], strict=True):
        target = statement.targets[0] if isinstance(statement, ast.Assign) else getattr(statement, "target", None)
        if isinstance(target, ast.Name):
            name = target.id
            if not name.startswith("_"):
                names.append(name)
                text = _docstring(following)
                if text is not None:
                    values = [_value(getattr(constants, n)) for n in names]
                    rows.append(_row("<br>".join(map(_code, names)), "<br>".join(values), _prose(text)))
                    names = []
    if names:
        raise ValueError(f"clsplat/constants.py: expected a docstring below {names[-1]}, found none")
    return "\n".join(rows)


def _type_name(hint: Any) -> str:
    if typing.get_origin(hint) is typing.Literal:
        return " | ".join(map(repr, typing.get_args(hint)))
    return hint.__name__ if isinstance(hint, type) else str(hint)


def _default(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def config_table(name: str) -> str:
    """Docstring of a configuration class and table of its fields with their ranges, as Markdown."""
    cls = getattr(config, name)
    body = ast.parse(inspect.getsource(cls)).body[0].body
    texts = {
        statement.target.id: _docstring(following) or ""
        for statement, following in zip(body, [*body[1:], None], strict=True)
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name)
    }
    hints, annotated = typing.get_type_hints(cls), typing.get_type_hints(cls, include_extras=True)
    rows = [_row("field", "type", "default", "meaning, and range"), HEADER_RULE * 4 + "|"]
    for field in dataclasses.fields(cls):
        hint = hints[field.name]
        nested = dataclasses.is_dataclass(hint)
        kind = f"[{hint.__name__}](#{hint.__name__.lower()})" if nested else _code(_type_name(hint))
        default = "" if nested else _code(_default(field.default))
        rule = rule_of(annotated[field.name])
        words = f" *Range: {_prose(rule.words)}.*" if rule else ""
        rows.append(_row(_code(field.name), kind, default, _prose(texts[field.name]) + words))
    return f"{_prose(cls.__doc__ or '')}\n\n" + "\n".join(rows)


def _flags(settings: dict[str, Any], within: str = "") -> list[str]:
    """Command line options for settings."""
    texts = []
    for name, value in settings.items():
        if isinstance(value, dict):
            texts += _flags(value, f"{within}{name}.")
        else:
            texts.append(f"--{within}{name} {value}".replace("_", "-"))
    return texts


def presets_table() -> str:
    """Markdown table of the presets, with equivalent options."""
    rows = [_row("preset", "the same as"), HEADER_RULE * 2 + "|"]
    for name in presets.PRESETS:
        settings = presets.read_settings(presets.FOLDER / f"{name}.json")
        rows.append(_row(_code(name), " ".join(map(_code, _flags(settings)))))
    return "\n".join(rows)


def help_text(command: str) -> str:
    """Output of ``clsplat COMMAND --help-all`` on a terminal with 100 columns, without colours."""
    text = io.StringIO()
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "100"
    try:
        with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            cli.main([*command.split(), "--help-all"])
    finally:
        os.environ.pop("COLUMNS") if before is None else os.environ.update(COLUMNS=before)
    return re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue())


class Table(SphinxDirective):
    """Base of directives that parse Markdown generated from a module."""

    def parse(self, text: str, module: ModuleType) -> list[nodes.Node]:
        self.env.note_dependency(module.__file__)
        return self.parse_text_to_nodes(text)


class Constants(Table):
    """``{constants}``"""

    def run(self) -> list[nodes.Node]:
        return self.parse(constants_table(), constants)


class Config(Table):
    """``{config} NAME``"""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        return self.parse(config_table(self.arguments[0]), config)


class Presets(Table):
    """``{presets}``"""

    def run(self) -> list[nodes.Node]:
        for name in presets.PRESETS:
            self.env.note_dependency(str(presets.FOLDER / f"{name}.json"))
        return self.parse(presets_table(), presets)


class Command(SphinxDirective):
    """``{command} NAME``. The name of a sub-command follows that of its command."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        self.env.note_dependency(cli.__file__)
        self.env.note_dependency(config.__file__)
        text = help_text(self.arguments[0])
        return [nodes.literal_block(text, text, language="text")]


class BenchKernels(SphinxDirective):
    """``{bench_kernels} FILE [WORKLOAD | model]``. The path of the file is relative to the page."""

    required_arguments = 1
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        relative, path = self.env.relfn2path(self.arguments[0])
        self.env.note_dependency(relative)
        results = json.loads(Path(path).read_text())
        if len(self.arguments) == 1:
            return self.parse_text_to_nodes(report.summary(results))
        if self.arguments[1] == "model":
            return self.parse_text_to_nodes(model_text(results))
        workload = next(w for w in results["workloads"] if w["name"] == self.arguments[1])
        return self.parse_text_to_nodes(report.details(workload))


class BenchTable(SphinxDirective):
    """A table that `text` makes of the results in a file. The path of the file is relative to the page."""

    required_arguments = 1
    text: typing.ClassVar[typing.Callable[[dict[str, Any]], str]]

    def run(self) -> list[nodes.Node]:
        relative, path = self.env.relfn2path(self.arguments[0])
        self.env.note_dependency(relative)
        return self.parse_text_to_nodes(type(self).text(json.loads(Path(path).read_text())))


class BenchStability(SphinxDirective):
    """``{bench_stability} FILE``. The path is relative to the page; the charts are in the folder of the file."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        relative, path = self.env.relfn2path(self.arguments[0])
        self.env.note_dependency(relative)
        results = json.loads(Path(path).read_text())
        parts = [stability.table(results, ALL_EXPERIMENTS), "Measured on", stability.origin(results, ALL_EXPERIMENTS)]
        folder = self.arguments[0].rpartition("/")[0]
        for name in stability.charts(results, ALL_EXPERIMENTS):
            failure = ALL_EXPERIMENTS[name].failure
            parts.append(f"![{failure}: results without and with the remedy]({folder}/{stability.chart_file(name)})")
        return self.parse_text_to_nodes("\n\n".join(parts))


class Charts(SphinxDirective):
    """Base of directives whose charts are drawn while the page is built."""

    def chart(self, figure: Figure, name: str, text: str) -> str:
        """Write a chart to docs/generated, and return the Markdown that shows it."""
        folder = Path(self.env.srcdir) / "generated"
        folder.mkdir(exist_ok=True)
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        return f"![{text}](/generated/{name}.svg)"

    def table(self, rows: list[list[str]]) -> str:
        """Markdown of a table. The first row is the header."""
        head, *body = [_row(*map(_prose, row)) for row in rows]
        return "\n".join([head, HEADER_RULE * len(rows[0]) + "|", *body])


class BenchQuality(Charts):
    """``{bench_quality} FILE [COST]``. The path of the file is relative to the page."""

    required_arguments = 1
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        relative, path = self.env.relfn2path(self.arguments[0])
        self.env.note_dependency(relative)
        records = results.read_records(Path(path))
        finished = quality_summary.runs(records)
        if len(self.arguments) == 1:
            parts = [self.list(quality_summary.origins(records))]
            if failed := quality_summary.failures(records):
                parts.append(self.table([["failed", "reason"], *map(list, failed)]))
            return self.parse_text_to_nodes("\n\n".join(parts))
        cost, parts = self.arguments[1], []
        metrics = quality_summary.measured_metrics(finished)
        for metric in metrics if cost == "seconds" else metrics[:1]:  # the table has all metrics
            names = quality_summary.METRICS[metric].name, quality_summary.COSTS[cost].name
            text = f"{names[0]} against {names[1]}; the table below has the figures"
            figure = charts.quality_chart(finished, cost, metric)
            parts += [self.chart(figure, f"{Path(path).stem}-{cost}-{metric}", text)]
            parts += [self.list(quality_summary.verdict(finished, cost, metric))]
        return self.parse_text_to_nodes("\n\n".join([*parts, self.table(quality_summary.table(finished, cost))]))

    def list(self, sentences: list[str]) -> str:
        return "\n".join(f"* {_prose(sentence)}" for sentence in sentences)


class BenchCaptures(SphinxDirective):
    """``{bench_captures} FILE [captures]``. The path of the file is relative to the page."""

    required_arguments = 1
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        relative, path = self.env.relfn2path(self.arguments[0])
        self.env.note_dependency(relative)
        records = results.read_records(Path(path))
        if not records:
            raise self.error(f"{path}: expected records of clsplat bench captures, found none")
        if len(self.arguments) > 1:
            return self.parse_text_to_nodes(captures_report.details(records))
        origins = "\n".join(f"* {_prose(line)}" for line in quality_summary.origins(records))
        return self.parse_text_to_nodes(f"{origins}\n\n{captures_report.summary(records)}")


class PublishedQuality(Charts):
    """``{published_quality}``"""

    def run(self) -> list[nodes.Node]:
        self.env.note_dependency(str(charts.PUBLISHED))
        text = "PSNR against training time as published in 2023; the table below has the figures"
        picture = self.chart(charts.published_chart("psnr"), "quality-published", text)
        return self.parse_text_to_nodes(f"{picture}\n\n{self.table(charts.published_table())}")


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("constants", Constants)
    app.add_directive("config", Config)
    app.add_directive("presets", Presets)
    app.add_directive("command", Command)
    app.add_directive("bench_kernels", BenchKernels)
    app.add_directive("bench_knobs", type("BenchKnobs", (BenchTable,), {"text": knobs_text}))
    app.add_directive("bench_viewer", type("BenchViewer", (BenchTable,), {"text": frames_text}))
    app.add_directive("bench_stability", BenchStability)
    app.add_directive("bench_quality", BenchQuality)
    app.add_directive("bench_captures", BenchCaptures)
    app.add_directive("published_quality", PublishedQuality)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
