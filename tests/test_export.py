"""Exports, each read back by a program of its own: compilers, simulators, other libraries."""

import ctypes
import re
import shutil
import subprocess
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import dahl_ident as di
from dahl_ident.elements import Element, Model
from dahl_ident.errors import DataError, FitError, ModelError, ValidationError

pytestmark = pytest.mark.versions

DAHL = di.Dahl(0.1, 30.0, alpha=1.0)


def fitted(truth, model=None):
    """Return a fit to a noisy table of a device; without a model, of its size alone."""
    amplitude = np.geomspace(3e-4, 3e-2, 12)
    exact = Model(truth).dynamic_stiffness(amplitude, 1.0)
    noise = np.random.default_rng(1).normal(0.0, 2e-3, (2, amplitude.size))
    N = exact * np.exp(noise[0] + 1j * noise[1])
    data = di.FrequencyResponse(np.ones(amplitude.size), N, amplitude)
    return di.fit(data, truth + di.Damper(name="added") if model is None else model, throw=False)


def motion(seed=1, samples=4000):
    """Return time, displacement and velocity that turn back at many places, and rest at some."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / 500.0
    waves = [(a, f, rng.uniform(0, 7)) for a, f in ((8e-3, 0.3), (3e-3, 1.1), (1e-3, 4.3))]
    x = sum(a * np.sin(2 * np.pi * f * t + p) for a, f, p in waves)
    v = sum(2 * np.pi * f * a * np.cos(2 * np.pi * f * t + p) for a, f, p in waves)
    x, v = np.asarray(x), np.asarray(v)
    x[1000:1100] = x[1000]
    v[1000:1100] = 0.0
    return t, x, v


def force_of(fit, x, v):
    """Return the force of a fit's model, but for the mass."""
    parts = [e for e in fit.model.elements if e.kind != "mass"]
    return np.asarray(np.sum([e.force(x, velocity=v) for e in parts], axis=0))


LAWS: dict[str, Element] = {
    "dahl": DAHL,
    "soft": di.Dahl(0.1, 30.0, alpha=1.7),
    "sharp": di.Dahl(0.1, 30.0, alpha=0.5),
    "asymmetric": di.Dahl(0.1, 30.0, alpha=1.0, asymmetry=0.3),
    "saturating": di.BoucWen(30.0, 300.0, 80.0),
    "growing": di.BoucWen(30.0, -20.0, 300.0),
    "straight": di.BoucWen(30.0, 300.0, 0.0),
    "slips": di.MaxwellSlip([1e-3, 4e-3], [20.0, 10.0]),
    "several": DAHL + di.PowerDamper(0.05, 0.5) + di.Spring(2.0) + di.Mass(0.3),
}


@pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc")
@pytest.mark.parametrize("name", [*LAWS, "lugre"])
def test_the_c_function_gives_the_force(tmp_path, name):
    law = LAWS.get(name) or di.LuGre(0.1, 30.0, 1.5, 5e-3, micro_damping=0.02, viscous=0.1)
    fit = fitted(law)
    fit.export("c", tmp_path / "friction.h")
    (tmp_path / "f.c").write_text(
        '#include "friction.h"\nvoid run(int n, const double *x, const double *v, double *f)\n'
        "{ friction_state s; friction_start(&s, x[0], v[0]);\n"
        "  for (int i = 0; i < n; ++i) f[i] = friction_force(&s, x[i], v[i]); }\n"
    )
    subprocess.run(
        ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-shared", "-fPIC",
         "f.c", "-o", "f.so", "-lm"],
        cwd=tmp_path, check=True,
    )  # fmt: skip
    t, x, v = motion()
    force = np.zeros(t.size)
    pointers = [a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in (x, v, force)]
    ctypes.CDLL(str(tmp_path / "f.so")).run(t.size, *pointers)
    expected = force_of(fit, x, v)
    # where the force depends on the speed, the function takes it as constant between calls
    error = 2e-3 if name == "lugre" else 3e-9
    np.testing.assert_allclose(force, expected, atol=error * np.abs(expected).max())


def plant(fit, mass, drive, end):
    """Return time and displacement of a mass with the friction of a fit, by integration."""
    law, damper = fit.model.elements[0], fit.model.elements[1]
    values = [float(p.value or 0.0) for p in law.parameters]
    assert isinstance(law, di.Friction)

    def rate(t, y):
        slope = law.slope(y[2], np.sign(y[1]), y[1], values)
        force = law.output(y[2], slope, y[1], values)
        damping = float(damper.parameters[0].value or 0.0)
        return [y[1], (drive(t) - force - damping * y[1]) / mass, slope * y[1]]

    return solve_ivp(rate, (0.0, end), [0.0, 0.0, 0.0], max_step=1e-3, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("law", [DAHL, di.LuGre(0.1, 30.0, 1.5, 5e-3, 0.02, 0.1)])
def test_mujoco_moves_as_the_model(law):
    mujoco = import_module("mujoco")
    fit = fitted(law + di.Damper(0.2) + di.Mass(0.3), law + di.Damper() + di.Mass(0.3))
    model = mujoco.MjModel.from_xml_string(fit.export("mujoco"))
    state = mujoco.MjData(model)

    def drive(t):
        return 0.25 * float(np.sin(2 * np.pi * 0.7 * t) + 0.5 * np.sin(2 * np.pi * 1.9 * t))

    exact = plant(fit, 0.3, drive, 3.0)
    found = []
    while state.time < 3.0:
        state.qfrc_applied[0] = drive(state.time)
        mujoco.mj_step(model, state)
        found.append((state.time, state.qpos[0]))
    times, moved = np.transpose(found)
    expected = np.interp(times, exact.t, exact.y[0])
    assert np.abs(moved - expected).max() < 2e-3 * np.abs(expected).max()


def test_mujoco_takes_a_friction_limit_alone():
    mujoco = import_module("mujoco")
    fit = fitted(di.Dahl(0.1, 30.0, alpha=0.5) + di.Mass(0.3), di.Dahl(alpha=0.5) + di.Mass(0.3))
    model = mujoco.MjModel.from_xml_string(fit.export("mujoco-frictionloss"))
    assert model.dof_frictionloss[0] == pytest.approx(fit.params["f_max"].value, rel=1e-9)
    assert model.dof_armature[0] == 0.3


def test_urdf_is_a_limit_and_a_damping():
    fit = fitted(DAHL + di.Damper(0.2), di.Dahl(alpha=1.0) + di.Damper())
    text = str(fit.export("urdf"))
    read = ElementTree.fromstring(f"<joint>{text}</joint>").find("dynamics")
    assert float(read.attrib["friction"]) == pytest.approx(fit.params["f_max"].value, rel=1e-9)
    assert float(read.attrib["damping"]) == pytest.approx(fit.params["damping"].value, rel=1e-9)
    assert "the contact stiffness sigma is left out" in text


@pytest.mark.parametrize("name", ["dahl", "soft", "asymmetric", "saturating", "several", "lugre"])
def test_modelica_has_the_equations(name):
    """A small reader of the text integrates its equations."""
    law = LAWS.get(name) or di.LuGre(0.1, 30.0, 1.5, 5e-3, micro_damping=0.02, viscous=0.1)
    fit = fitted(law)
    text = str(fit.export("modelica"))
    values = dict(re.findall(r"(?:parameter|constant) Real (\w+)=([-+.e\d]+);", text))
    known: dict[str, Any] = {k: float(x) for k, x in values.items()}
    known |= {"abs": abs, "sign": np.sign, "exp": np.exp}
    right = dict(re.findall(r"^  (der\(z\d\)|f) = (.*);$", text.replace("^", "**"), re.MULTILINE))
    states = sorted(name for name in right if name != "f")
    waves = ((8e-3, 0.3), (3e-3, 1.1))

    def at(t, z):
        moved = {
            "s_rel": sum(a * (1 - np.cos(2 * np.pi * f * t)) for a, f in waves),
            "v_rel": sum(2 * np.pi * f * a * np.sin(2 * np.pi * f * t) for a, f in waves),
        }
        return known | moved | {state[4:-1]: value for state, value in zip(states, z, strict=True)}

    times = np.arange(0.0, 2.0, 1e-3)
    solved = solve_ivp(
        lambda t, z: [eval(right[s], at(t, z)) for s in states], (0.0, 2.0),
        np.zeros(len(states)), t_eval=times, max_step=2e-3, rtol=1e-7, atol=1e-10,
    )  # fmt: skip
    force = [float(eval(right["f"], at(t, z))) for t, z in zip(times, solved.y.T, strict=True)]
    moved = [at(t, solved.y[:, 0]) for t in times]
    x, v = (np.array([float(m[key]) for m in moved]) for key in ("s_rel", "v_rel"))
    expected = force_of(fit, x, v)
    assert np.abs(np.array(force) - expected).max() < 5e-3 * np.abs(expected).max()


def test_matlab_ufloat_and_latex_have_the_budget():
    fit = fitted(DAHL + di.Spring(2.0), di.Dahl(alpha=1.0) + di.Spring())
    budget = fit.budget()
    names = list(budget)
    assigned = dict(re.findall(r"^friction\.(\S+) = ([-+.e\d]+);", str(fit.export("matlab")), re.M))
    for name in names:
        assert float(assigned[name]) == fit.params[name].value
        assert float(assigned[f"u.{name}"]) == budget[name].u
    numbers: dict[str, Any] = {}
    exec(str(fit.export("ufloat")), numbers)
    covariance = import_module("uncertainties").covariance_matrix([numbers[name] for name in names])
    np.testing.assert_allclose(covariance, budget.covariance, rtol=1e-9)
    table = str(fit.export("latex"))
    assert r"$f_\mathrm{max}$ & $0.1" in table
    assert f"& {budget['f_max'].k:.2f} & N" in table
    for shown in (fit.params, budget):
        assert "<td>N</td>" in shown._repr_html_() or "f_max [N]" in shown._repr_html_()
        assert table.splitlines()[0][:15] == shown.to_latex()[:15]
    assert "<table" in fit.summary().to_html()


def test_gtc_has_the_budget_source_by_source():
    pytest.importorskip("GTC")
    fit = fitted(DAHL + di.Spring(2.0), di.Dahl(alpha=1.0) + di.Spring())
    budget = fit.budget()
    names = list(budget)
    gtc, persistence = import_module("GTC"), import_module("GTC.persistence")
    archive = persistence.loads_json(str(fit.export("gtc")))
    first, *others = archive.extract(*names)
    for name, number in zip(names, (first, *others), strict=True):
        assert gtc.uncertainty(number) == pytest.approx(budget[name].u, rel=1e-9)
        parts = {one.label: one.u for one in import_module("GTC.reporting").budget(number, trim=0)}
        for row in budget[name].rows:
            assert parts[f"{name}: {row.source}"] == pytest.approx(row.u, rel=1e-9)
    r = budget.covariance[0, 1] / (budget[names[0]].u * budget[names[1]].u)
    assert gtc.get_correlation(first, others[0]) == pytest.approx(r, rel=1e-9)


def test_draws_follow_the_fit_and_the_posterior(tmp_path):
    fit = fitted(DAHL, di.Dahl(alpha=1.0))
    fit.export("draws", tmp_path / "draws.parquet", size=20_000, seed=1)
    table = pd.read_parquet(tmp_path / "draws.parquet")
    assert list(table) == ["f_max [N]", "sigma [N/m]", "alpha"]
    assert (table["alpha"] == 1.0).all()
    budget = fit.budget()
    found = table[["f_max [N]", "sigma [N/m]"]].to_numpy()
    u = np.array([p.u for p in budget.values()])
    assert np.abs(found.mean(axis=0) - [p.value for p in budget.values()]).max() < 5 * u.max() / 141
    np.testing.assert_allclose(np.cov(found.T) / np.outer(u, u), budget.covariance / np.outer(u, u),
                               atol=0.05)  # fmt: skip
    again = str(fit.export("draws", size=5, seed=1))
    assert again == fit.export("draws", size=5, seed=1)
    posterior = di.posterior(fit.data, di.Dahl(alpha=1.0), method="grid")
    drawn = str(posterior.export("draws", size=5, seed=2)).splitlines()
    assert drawn[0].startswith("f_max [N],sigma [N/m]")
    assert len(drawn) == 6
    for result in (fit, posterior):
        with pytest.raises(ValidationError, match="seed is -1; expected a whole number >= 0"):
            result.export("draws", size=5, seed=-1)
    with pytest.raises(ValidationError, match="exported as 'draws' alone"):
        posterior.export("c")


def test_what_a_format_cannot_carry_is_refused_by_name(tmp_path):
    gap = fitted(di.Backlash(DAHL, 1e-4), di.Backlash(di.Dahl(alpha=1.0), 1e-4))
    for form in ("mujoco", "mujoco-frictionloss", "urdf", "modelica", "c"):
        with pytest.raises(
            ModelError, match=rf"{form} carries .*, and the model has backlash; fit"
        ):
            gap.export(form)
    assert "% backlash" in str(gap.export("matlab"))
    spring = fitted(DAHL + di.Spring(2.0), di.Dahl(alpha=1.0) + di.Spring())
    with pytest.raises(ModelError, match=r"urdf carries .*has spring"):
        spring.export("urdf")
    soft = fitted(di.Dahl(0.1, 30.0, alpha=1.7), di.Dahl(alpha=1.7))
    with pytest.raises(
        ModelError, match=r"alpha is 1\.7: the force would differ by 1\d % of f_max"
    ):
        soft.export("mujoco")
    near = fitted(di.Dahl(0.1, 30.0, alpha=1.02), di.Dahl(alpha=1.02))
    assert "alpha = 1.02 is taken as 1: within 0.54 % of f_max" in str(near.export("mujoco"))
    two = fitted(LAWS["asymmetric"])
    for form in ("mujoco", "urdf"):
        with pytest.raises(ModelError, match=f"{form} has one limit of friction for both"):
            two.export(form)
    with pytest.raises(ValidationError, match="expected one of mujoco, mujoco-frictionloss"):
        two.export("simulink")
    with pytest.raises(ValidationError, match=r"written as \.csv, \.parquet"):
        two.export("draws", tmp_path / "draws.xlsx")
    lost = di.fit(di.load_dataset("microslip"), di.Dahl() + di.Spring(), throw=False)
    with pytest.raises(FitError, match="has no finite uncertainty to export; see the verdict"):
        lost.export("ufloat")
    with pytest.raises(FitError, match="has no finite estimate"):
        lost.export("c")


def test_a_fit_of_records_is_exported_without_its_nuisances():
    _, x, v = motion(samples=1500)
    force = DAHL.force(x) + 0.2 * v + np.random.default_rng(0).normal(0.0, 1e-3, x.size)
    record = di.Record(np.arange(x.size) / 500.0, displacement=x, force=force)
    fit = di.fit(record, di.Dahl(alpha=1.0) + di.Damper())
    assert str(fit.export("draws", size=1)).splitlines()[0].count(",") == 3
    assert "initial" not in str(fit.export("ufloat"))
    assert "friction_dahl" in str(fit.export("c"))


def test_the_command_line(tmp_path, run):
    fit = fitted(DAHL, di.Dahl(alpha=1.0))
    fit.save("fit.json")
    assert run("export", "fit.json", "--to", "latex").out == fit.export("latex")
    done = run("export", "fit.json", "--to", "mujoco", "-o", "joint.xml")
    assert (done.status, done.out) == (0, "")
    assert Path("joint.xml").read_text() == fit.export("mujoco")
    refused = run("export", "fit.json", "--to", "mujoco", "-o", "joint.xml")
    assert (refused.status, "exists already" in refused.err) == (1, True)
    assert "'sdf' is not one of mujoco" in run("export", "fit.json", "--to", "sdf").err
    assert run("export", "fit.json").status == 2
    with pytest.raises(DataError):
        fit.export("c", "joint.xml")


def test_rotation_is_a_hinge_and_torques():
    angle = np.geomspace(3e-4, 3e-2, 12)
    N = DAHL.describing_function(angle) * np.exp(np.random.default_rng(1).normal(0, 2e-3, 12))
    data = di.FrequencyResponse(np.ones(12), N, angle, motion="rotation")
    fit = di.fit(data, di.Dahl(alpha=1.0))
    assert 'type="hinge"' in str(fit.export("mujoco"))
    assert "Rotational" in str(fit.export("modelica"))
    assert "f_max [N m],sigma [N m/rad]" in str(fit.export("draws", size=1))
    assert "forces with a memory, N m" in str(fit.export("c"))
    inertia = di.Mass(0.02).dynamic_stiffness(angle, 2.0 * np.pi) * (N / abs(N))
    alone = di.fit(di.FrequencyResponse(np.ones(12), inertia, angle, motion="rotation"), di.Mass())
    assert 'type="hinge"' in str(alone.export("mujoco"))
