"""Chains on disk: killed, resumed, damaged, foreign, shared."""

import hashlib
import os
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.errors import SamplingError, ValidationError
from dahl_ident.problem import TableProblem
from tests.bayes_cases import friction_table

STEPS = 800
h5py = import_module("h5py")
ROOT = Path(__file__).parents[1]
LONG_RUN = f"""
import sys
import dahl_ident as di
from tests.bayes_cases import friction_table
print("ready", flush=True)
di.posterior(
    friction_table(), di.Dahl(), seed=9, steps={STEPS}, resume=sys.argv[1], uncertainty="noise"
)
"""


def sampled(path, **options):
    return di.posterior(friction_table(), di.Dahl(), resume=path, **options, uncertainty="noise")


def refused(path, message, **options):
    """Check that a file is refused with a message, and left as it is."""
    before = hashlib.sha256(path.read_bytes()).digest()
    with pytest.raises(SamplingError, match=message):
        sampled(path, **options)
    assert hashlib.sha256(path.read_bytes()).digest() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.fixture
def begun(tmp_path):
    path = tmp_path / "chain.h5"
    sampled(path, seed=9, steps=60)
    return path


def test_resume_goes_on_to_a_total_and_changes_nothing(begun):
    resumed = sampled(begun, steps=130)
    whole = sampled(None, seed=9, steps=130)
    assert (resumed.steps, resumed.seed) == (130, 9)
    np.testing.assert_array_equal(resumed.get_chain(), whole.get_chain())
    np.testing.assert_array_equal(resumed.get_log_prob(), whole.get_log_prob())
    assert sampled(begun, steps=130).steps == 130
    assert [p.name for p in begun.parent.iterdir()] == [begun.name]


def test_resume_until_convergence_ends_where_one_run_ends(begun):
    resumed = sampled(begun)
    whole = sampled(None, seed=9)
    assert resumed.converged
    np.testing.assert_array_equal(resumed.get_chain(), whole.get_chain())


def test_killed_at_random_moments_it_ends_with_the_same_chain(tmp_path):
    path = tmp_path / "chain.h5"
    random = np.random.default_rng(11)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    kills = 0
    for _ in range(2):
        with subprocess.Popen(
            [sys.executable, "-c", LONG_RUN, str(path)], stdout=subprocess.PIPE, env=environment
        ) as process:
            assert process.stdout.readline() == b"ready\n"
            time.sleep(random.uniform(0.1, 0.8))
            process.send_signal(signal.SIGKILL)
            kills += process.wait() == -signal.SIGKILL
    assert kills > 0
    resumed = sampled(path, seed=9, steps=STEPS)
    whole = sampled(None, seed=9, steps=STEPS)
    np.testing.assert_array_equal(resumed.get_chain(), whole.get_chain())


def test_an_exception_leaves_all_steps_in_the_file(tmp_path, monkeypatch):
    path = tmp_path / "chain.h5"
    calls = 0
    likelihood = TableProblem.log_likelihood

    def interrupted(self, *args):
        nonlocal calls
        calls += 1
        if calls == 300:
            raise KeyboardInterrupt
        return likelihood(self, *args)

    monkeypatch.setattr(TableProblem, "log_likelihood", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sampled(path, seed=9, steps=400)
    monkeypatch.undo()
    with h5py.File(path, "r") as file:
        assert 50 <= len(file["points"]) < 200
    resumed = sampled(path, steps=200)
    np.testing.assert_array_equal(resumed.get_chain(), sampled(None, seed=9, steps=200).get_chain())


def test_foreign_runs_are_refused(begun):
    refused(begun, "was begun with seed 9, but seed is 8", seed=8)
    refused(begun, "it differs in prior of f_max. Resume with", priors={"f_max": (1e-3, 1.0)})
    refused(begun, "differs in noise", noise="absolute")
    refused(begun, "differs in walkers", walkers=160)
    before = begun.read_bytes()
    with pytest.raises(SamplingError, match="differs in data"):
        di.posterior(friction_table(seed=2), di.Dahl(), resume=begun, uncertainty="noise")
    with pytest.raises(SamplingError, match="differs in model"):
        di.posterior(friction_table(), di.Dahl(alpha=1.1), resume=begun, uncertainty="noise")
    assert begun.read_bytes() == before


def test_damaged_files_are_refused(begun):
    whole = begun.read_bytes()
    begun.write_bytes(whole[: len(whole) // 2])
    refused(begun, "cannot be read as a chain .*damaged or of another kind")
    begun.write_bytes(b"amplitude,gain\n1,2\n")
    refused(begun, "cannot be read as a chain")
    begun.write_bytes(whole)
    with h5py.File(begun, "r+") as file:
        file["points"][3, 2, 1] += 1e-12
    refused(begun, "content does not match the digest")
    begun.write_bytes(whole)
    with h5py.File(begun, "r+") as file:
        del file["start"]
    refused(begun, "cannot be read as a chain")


def test_other_hdf5_files_are_refused(tmp_path):
    path = tmp_path / "table.h5"
    with h5py.File(path, "w") as file:
        file["amplitude"] = np.ones(3)
    refused(path, f"^{path} is an HDF5 file, but not a chain that this version can resume")


def test_two_runs_exclude_each_other(tmp_path):
    path = tmp_path / "chain.h5"
    with subprocess.Popen(
        [sys.executable, "-c", LONG_RUN.replace(str(STEPS), "1000000"), str(path)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ) as process:
        try:
            deadline = time.monotonic() + 60.0
            while not path.exists() and process.poll() is None and time.monotonic() < deadline:
                time.sleep(0.02)
            with pytest.raises(SamplingError, match=r"another run is writing .*chain\.h5; wait"):
                sampled(path, steps=50)
        finally:
            process.kill()


def test_a_lock_left_by_a_killed_run_does_not_matter(tmp_path):
    (tmp_path / "chain.h5.lock").touch()
    assert sampled(tmp_path / "chain.h5", seed=9, steps=60).steps == 60


def test_a_missing_folder_and_a_folder_are_said(tmp_path):
    with pytest.raises(ValidationError, match="resume is 3; expected its path"):
        sampled(3, steps=50)
    with pytest.raises(SamplingError, match="is a folder; give the path of a file in it"):
        sampled(tmp_path, steps=50)
    with pytest.raises(SamplingError, match="nowhere is not a folder; make it"):
        sampled(tmp_path / "nowhere" / "chain.h5", steps=50)
