"""Measurements made by others, read as their laboratories left them."""

import warnings

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.io import loadmat

from benchmarks.measured import FOLDER, beam_table
from dahl_ident.data import inspect, read_frequency_response, read_record
from tests.measured import dampers, needs_measured

pytestmark = needs_measured
FILES = sorted((FOLDER / "brfd").glob("*.csv"))


@pytest.fixture(scope="module")
def beam():
    return beam_table()


class TestBrakeReussBeam:
    def test_twelve_levels_with_one_map(self, beam):
        assert beam.n == 12 * 41
        assert beam.levels == [f"ForceControl[{i}]" for i in range(4)] + [
            f"ResponseControl[{i}]" for i in range(8)
        ]
        assert (beam.quantity, beam.unit) == ("receptance", "m/N")
        assert "columns not used: FRdata.ForceControl[0].units" in repr(beam)
        for label in beam.levels:
            held = "force" if label.startswith("Force") else "displacement"
            assert set(beam.select(level=label).controlled) == {held}

    def test_numbers_are_the_file_s(self, beam):
        content = loadmat(
            str(FOLDER / "brb" / "ForcedFrequencyResponses.mat"), simplify_cells=True
        )["FRdata"]
        for label in beam.levels:
            kind, index = label.rstrip("]").split("[")
            raw, part = content[kind][int(index)], beam.select(level=label)
            displacement = raw["amplitude"] / (2 * np.pi * raw["frequency"]) ** 2
            np.testing.assert_allclose(part.amplitude, displacement, rtol=1e-14)
            np.testing.assert_array_equal(part.drive, raw["force"])
            expected = displacement / raw["force"] * np.exp(1j * raw["phase"])
            np.testing.assert_allclose(part.response, expected, rtol=1e-13)

    def test_the_beam_dissipates(self, beam):
        """Passive at every point, and resonant within the band, as a displacement's phase says."""
        Z = beam.to("dynamic_stiffness")
        assert (Z.response.imag > 0.0).all()
        for label in beam.levels:
            real = Z.select(level=label).response.real
            assert real[0] > 0.0 > real[-1]

    def test_force_of_a_response_controlled_level_varies(self, beam):
        for label in beam.levels[4:]:
            part = beam.select(level=label)
            assert part.drive.min() < 0.5 * part.drive.max()
            assert part.amplitude.max() < 1.2 * part.amplitude.min()

    def test_inspect_proposes_the_paths(self):
        contents = inspect(FOLDER / "brb" / "ForcedFrequencyResponses.mat")
        for name in ("frequency", "amplitude", "force", "phase"):
            assert f'column = "FRdata.*[*].{name}"' in contents.column_map

    def test_survives_a_file(self, beam, tmp_path):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            back = read_frequency_response(beam.save(tmp_path / "brb.csv.gz"))
        np.testing.assert_array_equal(back.response, beam.response)
        assert back.levels == beam.levels


class TestFrictionDamper:
    @pytest.mark.parametrize("path", FILES, ids=[file.stem for file in FILES])
    def test_every_file_is_a_record(self, path):
        record = read_record(path, displacement="displacement", force="friction force")
        raw = np.loadtxt(path, delimiter=",", skiprows=1)
        np.testing.assert_array_equal(record.time, raw[:, 0])
        kip = 1000.0 * 0.45359237 * 9.80665
        np.testing.assert_allclose(record.displacement, raw[:, 1] * 0.0254, rtol=1e-14)
        np.testing.assert_allclose(record.force, raw[:, 2] * kip, rtol=1e-14)
        assert record.sample_rate == pytest.approx(1024.0, rel=1e-6)
        assert record.uniform
        assert not len(record.gaps)
        assert record.provenance["notes"] == [
            "columns not used: velocity, actuator force 1, actuator force 2"
        ]

    def test_there_are_ten(self):
        assert len(FILES) == 10

    def test_the_damper_dissipates(self):
        """Work over a whole test is positive, in joules that kip and inch alone would not give."""
        (record,) = dampers("0.5Hz_1in")
        work = float(trapezoid(record.force_samples, record.displacement))
        assert 1e3 < work < 1e5

    def test_of_two_motions_the_displacement_is_used(self):
        record = read_record(FOLDER / "brfd" / "band30lb_2Hz_0.5in.csv", force="friction force")
        assert record.motion_channel == "displacement"
        assert "displacement is used, and not velocity" in (record.provenance or {})["notes"]
