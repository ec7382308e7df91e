"""The benchmark of active runs: which of them there are, and that what fails is told."""

import pytest
from active_benchmark import estimators, policies, runs
from benchmarking.report import Options

from factorgraph_loc.experiments.active import ROW, ActiveResults

FIGURES = {
    "status": "ok",
    "localized": True,
    "metres": 3.0,
    "seconds": 6.0,
    "error_position": 0.1,
    "error_heading": 0.02,
}


@pytest.fixture
def asked(monkeypatch):
    """Runs take no time, and those of the warehouse by smoothers fail; the jobs are returned."""
    jobs = []

    def run_jobs(work, workers, progress):
        jobs.extend(work)
        assert workers == 2
        progress(0, len(work))
        rows = []
        for job in work:
            for seed in job.seeds:
                row = {**dict.fromkeys(ROW), **FIGURES, "claimed_wrong": False, "steps": 1, "planning_ms": 5.0}
                row |= {"world": job.simulation.name, "policy": job.policy, "estimator": job.estimator, "seed": seed}
                rows.append(row)
        failed = [job.name for job in work if job.estimator == "smoother" and job.simulation.name == "warehouse"]
        return ActiveResults(rows, failed)

    monkeypatch.setattr(runs, "run_jobs", run_jobs)
    monkeypatch.setattr(runs, "write_picture", lambda figure, path: path.write_text(figure.get_suptitle()))
    return jobs


def test_every_policy_runs_in_every_world_on_the_same_seeds(asked, tmp_path):
    report = policies.section(Options(3, 2, None, tmp_path))
    assert {(job.simulation.name, job.policy) for job in asked} == {
        (world, policy) for world in runs.WORLDS for policy in policies.POLICIES
    }
    assert {job.seeds for job in asked} == {(0, 1, 2)}
    assert not report.failed
    text = "\n".join(report.lines)
    assert "3 robots in each world" in text
    assert "| symmetric | information / paper_literal | active_mcl | 3 | 0.0 (0.0 to 0.0) |" in text
    assert (tmp_path / "policies" / "results.parquet").exists()
    assert (tmp_path / "policies" / "comparison.png").read_text().endswith("3 runs of each")


def test_what_fails_is_told(asked, tmp_path):
    report = estimators.section(Options(1, 2, None, tmp_path))
    assert len(asked) == len(runs.WORLDS) * len(estimators.ESTIMATORS) * len(estimators.POLICIES)
    assert report.failed == [f"warehouse-smoother-{policy}" for policy in estimators.POLICIES]


def test_jobs_of_two_sections_are_kept_at_one_place(asked, tmp_path):
    """The runs of active_mcl on the first seeds are in both tables, and are run once."""
    policies.section(Options(10, 2, None, tmp_path))
    first = {job.part for job in asked}
    asked.clear()
    estimators.section(Options(10, 2, None, tmp_path))
    same = {job.part for job in asked if job.estimator == "active_mcl"}
    assert same < first
