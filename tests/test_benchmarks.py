"""The benchmark programs at tiny sizes: what they compute and report, never how fast."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import candidates
import cases
import compare
import frames
import gate
import peers
import report
import rows
import run
import targets
from plan import FULL_SECONDS, QUICK_SECONDS, Limits, Plan
from suites import SUITES
from surfconv_ops import SurfConv2d
from timing import Timing, interleave

ONCE = Limits(seconds=0.0, minimum=1, maximum=1)


#: Where frames 16 times smaller would leave a net, or two sizes, too small to tell apart, or an
#: output that fits into pages that the process already has.
SHRINK = {"net": 4, "scaling": 4, "memory": 4}


def tiny_plan(*suites: str, quick: bool = False, threads: tuple[int, ...] = (1,)) -> Plan:
    seconds = dict.fromkeys(("gate", *suites), 0.0)
    shrink = min(SHRINK.get(name, 16) for name in ("gate", *suites))
    return Plan(quick, threads, seconds, minimum=1, maximum=1, shrink=shrink)


@pytest.mark.parametrize("name", SUITES)
def test_every_suite_measures_rows_that_identify_themselves(name: str) -> None:
    # Two threads wait long for each other on a busy machine: only where there is no other way.
    threads = (1, 2) if name == "scaling" else (1,)
    plan = tiny_plan(name, quick=name in ("memory", "scaling", "invariance"), threads=threads)
    jobs = SUITES[name].jobs(plan)
    found = [row for job in jobs for row in job.measure(ONCE)]
    assert {row.suite for row in found} == {name}
    assert max(Counter(row.key for row in found).values()) == 1
    assert all(job.work > 0 for job in jobs)
    for row in found:
        assert row.low <= row.value <= row.high, row
        assert row.value > 0 or row.unit == "correlation", row
        assert (row.verdict != "") == (row.target is not None), row
        if row.target is not None:
            assert row.ratio is not None
            good = row.ratio >= row.target if row.target_sense == "at least" else (
                row.ratio <= row.target
            )  # fmt: skip
            assert row.verdict == ("met" if good else "missed"), row
    assert any(row.verdict for row in found)
    assert set(rows.COLUMNS) == set(dataclasses.asdict(found[0]))


@pytest.mark.parametrize("quick", [False, True])
def test_every_job_of_a_plan_can_be_listed_without_measuring(quick: bool) -> None:
    plan = Plan(quick, (1, 2), QUICK_SECONDS if quick else FULL_SECONDS, 2, 3)
    labels = [(name, job.label) for name, suite in SUITES.items() for job in suite.jobs(plan)]
    assert len(labels) == len(set(labels))
    timed = {shape for shape in cases.MAIN if ("layers", f"{shape} forward, 1 thread") in labels}
    assert timed == ({"A", "D"} if quick else set("ABCDE"))


def test_the_seconds_planned_are_what_is_promised() -> None:
    assert set(FULL_SECONDS) == set(QUICK_SECONDS) == {"gate", *SUITES}
    assert 240 <= sum(FULL_SECONDS.values()) <= 310
    assert sum(QUICK_SECONDS.values()) <= 50


def test_interleaved_rounds_and_a_slow_call_that_sits_out() -> None:
    order: list[str] = []

    def slow() -> None:
        order.append("slow")
        time.sleep(0.02)

    limits = Limits(seconds=0.012, minimum=2, maximum=40)
    timings = interleave({"slow": slow, "fast": lambda: order.append("fast")}, limits)
    assert order[:6] == ["slow", "fast"] * 3
    assert len(timings["slow"].seconds) == 2
    limits = Limits(seconds=10.0, minimum=1, maximum=5)
    assert len(interleave({"fast": lambda: None}, limits)["fast"].seconds) == 5


def test_a_row_holds_medians_ratios_and_the_verdict() -> None:
    key = rows.Key("s", "t", "c", "x", "forward")
    ours, base = Timing([0.002, 0.003, 0.004]), Timing([0.001, 0.002, 0.004])
    row = rows.make_row(key, ours, baseline=("b", base), target=targets.Target(1.4))
    assert (row.value, row.samples, row.ratio) == (3.0, 3, pytest.approx(1.5))
    assert (row.ratio_low, row.ratio_high) == (pytest.approx(1.25), pytest.approx(1.75))
    assert (row.target_sense, row.verdict) == ("at most", "missed")
    lead = rows.make_row(
        key, base, baseline=("b", ours), target=targets.Target(1.5, at_least=True), inverse=True
    )
    assert (lead.ratio, lead.verdict) == (pytest.approx(1.5), "met")


def wrong(*arguments: object, scale: Tensor, **options: object) -> Tensor:
    from surfconv_ops import surf_conv2d

    return surf_conv2d(*arguments, scale=scale * 1.01, **options)


def test_the_gate_is_green_on_every_checked_layer() -> None:
    checks = [check for _, job in gate.gate(tiny_plan(quick=True)) for check in job()]
    failed = [check for check in checks if not check.passed]
    assert not failed, failed
    names = ["A", "D", *cases.NET_LAYERS, *cases.GROUPED, *cases.POINTWISE]
    assert all(any(check.what.startswith(f"{name} ") for check in checks) for name in names)


def test_the_gate_sees_a_wrong_operator_and_a_wrong_layer(monkeypatch: pytest.MonkeyPatch) -> None:
    layer = cases.MAIN["A"].shrunk(8)
    scene = candidates.scene_of(layer, frames.make_scene, frames.RANDOM)

    def failures() -> list[str]:
        checks = gate.against_relation(layer, candidates.CONTINUOUS, scene)
        return [check.what for check in checks if not check.passed]

    assert not failures()
    with monkeypatch.context() as patch:
        patch.setattr(gate, "surf_conv2d", wrong)
        assert any("output at points" in what for what in failures())
        assert not all(check.passed for check in gate.at_scale_one(layer))
    forward = SurfConv2d.forward
    monkeypatch.setattr(SurfConv2d, "forward", lambda self, x, z: forward(self, x, 1.01 * z))
    assert failures() and all(what.endswith(": layer") for what in failures())


def test_a_red_gate_reports_no_speed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run, "make_plan", lambda *_: tiny_plan("grouped", quick=True))
    monkeypatch.setattr(gate, "surf_conv2d", wrong)
    assert run.main(["--quick", "--out", str(tmp_path)]) == 1
    assert "no speed is reported" in capsys.readouterr().err
    data = json.loads((tmp_path / "results.json").read_text())
    assert data["rows"] == [] and data["gate"]["passed"] is False
    assert "No speed is reported" in (tmp_path / "results.md").read_text()
    assert (tmp_path / "results.csv").read_text().count("\n") == 1
    assert not list(tmp_path.glob("*.png"))


def test_a_run_writes_everything_and_compares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tiny_plan("levels", "grouped", quick=True)
    monkeypatch.setattr(run, "make_plan", lambda *_: plan)
    monkeypatch.setattr(run, "gate", lambda _: [("one", lambda: [gate.Check("fine", 0.0)])])
    assert run.main(["--out", str(tmp_path), "--no-charts"]) == 0
    old = tmp_path / "old.json"
    (tmp_path / "results.json").rename(old)
    pytest.importorskip("matplotlib")
    assert run.main(["--out", str(tmp_path), "--compare", str(old)]) == 0
    assert "Took " in capsys.readouterr().out
    data, found = report.read_rows(tmp_path / "results.json")
    assert data["machine"]["threads"] == [1] and data["machine"]["torch"] == torch.__version__
    assert {"commit", "cpu", "surfconv_cpu_capability", "depth"} <= set(data["machine"])
    assert data["columns"] == rows.COLUMNS
    assert {row.suite for row in found} == {"levels", "grouped"}
    assert (tmp_path / "results.csv").read_text().count("\n") == 1 + len(found)
    for name in ("levels.png", "grouped.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
        assert f"]({name})" in (tmp_path / "results.md").read_text()
    assert f"{len(found)} rows in both" in (tmp_path / "compare.md").read_text()


def test_compare_marks_what_lies_beyond_the_quartiles() -> None:
    key = {"suite": "s", "table": "t", "subject": "x", "direction": "forward"}
    old = rows.Row(case="a", value=10.0, low=9.0, high=11.0, ratio=2.0, **key)
    same = dataclasses.replace(old, value=11.5, low=10.5, high=12.0)
    slow = dataclasses.replace(old, value=13.0, low=12.0, high=14.0, ratio=2.6)
    fast = dataclasses.replace(old, value=8.0, low=7.0, high=8.5)
    marks = [compare.match([old], [new])[0].mark for new in (same, slow, fast)]
    assert marks == [compare.WITHIN, compare.SLOWER, compare.FASTER]
    big = dataclasses.replace(slow, unit="MiB")
    assert compare.Change(dataclasses.replace(old, unit="MiB"), big).mark == compare.MORE
    machine = {"commit": "c", "time": "now", "cpu": "one"}
    other = dataclasses.replace(slow, case="b")
    text = compare.render(
        ({"machine": machine}, [old]), ({"machine": {**machine, "cpu": "two"}}, [slow, other])
    )
    assert "| 10 | 13 | ms | 1.30 | SLOWER | 2.00 | 2.60 |" in text
    assert "1 rows in both; 1 SLOWER" in text and "1 only in new" in text
    assert "not the same cpu" in text


def test_compare_refuses_what_is_no_result(tmp_path: Path) -> None:
    file = tmp_path / "other.json"
    file.write_text("{}")
    assert run.main(["--compare", str(file)]) == 2
    assert compare.main([str(file), str(tmp_path / "missing.json")]) == 2


def test_a_peer_that_cannot_be_used_is_named_with_its_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "torchvision", None)
    monkeypatch.setitem(sys.modules, "torchvision.ops", None)
    peers.deform_conv2d.cache_clear()
    try:
        assert "torchvision cannot be used" in peers.unavailable()[peers.DEFORM]
        jobs = SUITES["peers"].jobs(tiny_plan("peers", quick=True))
        found = [row.subject for job in jobs for row in job.measure(ONCE)]
        assert peers.DEFORM not in found and peers.GRID_SAMPLE in found
    finally:
        peers.deform_conv2d.cache_clear()
