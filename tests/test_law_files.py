"""A law in a user's file: command line, campaigns, saved fits, worker processes."""

import copy
import importlib
import json
import pickle
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.elements import KINDS
from dahl_ident.elements.law_files import load_laws
from dahl_ident.errors import DataError, ModelError, ValidationError

LAW = '''
import dahl_ident as di
from limits import LOWEST

class Jenkins(di.Friction):
    """dF/dx = k until full slip."""

    kind = "{kind}"
    parameters = (
        di.Parameter("k", "N/m", "stiffness", lower=LOWEST, transform="log"),
        di.Parameter("f_max", "N", "friction limit", lower=LOWEST, transform="log"),
    )

    def slope(self, force, direction, velocity, values):
        k, f_max = values
        return {factor} * k * (direction * force < f_max)


class NoKind{kind}(Jenkins):
    kind = ""
'''
DATA = ("--levels", "1e-3:3e-2:6", "--force-std", "0.01")


@pytest.fixture
def file(tmp_path, request):
    """Return a file with a law whose kind nothing else has."""
    (tmp_path / "limits.py").write_text("LOWEST = 0.0\n")
    path = tmp_path / "my_laws.py"
    path.write_text(LAW.format(kind=kind_of(path), factor=1.0))
    return path


def kind_of(path):
    return f"jenkins_{abs(hash(path))}"


def table(path):
    A = np.geomspace(1e-3, 3e-2, 12)
    (law, _) = load_laws(path)
    rng = np.random.default_rng(3)
    N = law(k=30.0, f_max=0.1).dynamic_stiffness(A)  # type: ignore[call-arg]
    noise = np.exp(0.01 * (rng.standard_normal(12) + 1j * rng.standard_normal(12)))
    data = di.FrequencyResponse(np.ones(12), N * noise, A)
    return data.save(path.parent / "d1.csv", overwrite=True)


def test_commands_know_it(file, run):
    folder, kind, laws = file.parent, kind_of(file), ("--laws", str(file))
    csv, saved = str(folder / "d1.csv"), str(folder / "fit.json")
    truth = ("--element", f"{kind}(k=30, f_max=0.1)")
    assert run("simulate", *laws, *truth, *DATA, "-o", csv).status == 0
    fitted = run("fit", csv, *laws, "--element", f"NoKind{kind}", "--save", saved, "--json")
    assert json.loads(fitted.out)["params"]["k"]["value"] == pytest.approx(30.0, rel=0.02)
    planned = run("plan", saved, *laws, "--frequency", "1", "--displacement", "0.03",
                  "--noise", "0.01", "--time", "600", "--target", "f_max")  # fmt: skip
    assert planned.status == 0
    page = folder / "page.md"
    assert run("report", saved, *laws, "-o", str(page)).status == 0
    assert f"--laws {file}" in page.read_text().replace("\\", "")
    assert run("export", saved, *laws, "--to", "draws", "--size", "3").out.count("\n") == 4


def test_options_files_take_it(file, run):
    options = file.parent / "options.toml"
    options.write_text(f"laws = {str(file)!r}\n[fit]\nelement = {kind_of(file)!r}\n")
    assert run("fit", str(table(file)), "--config", str(options)).status == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\n\n1 / 0\n", "my_laws.py, line 3: ZeroDivisionError: division by zero; expected a"),
        ("def f(:\n", "my_laws.py, line 1: SyntaxError"),
        ("raise SystemExit(3)\n", "line 1: SystemExit: 3"),
        ("import dahl_ident as di\nlaw = di.Dahl\n", "my_laws.py defines no law; expected"),
        ("import dahl_ident as di\nclass A(di.Friction):\n    kind = 'dahl'\n",
         "A has the kind 'dahl', which .*Dahl has already; choose another"),
        ("import dahl_ident as di\nclass A(di.Friction):\n"
         "    parameters = (di.Parameter('a', 'N', 'a', lower=2.0, upper=1.0),)\n"
         "    def slope(self, *_):\n        return 1.0\n", r"A: a has the bounds \(2.0, 1.0\)"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_file_is_said(tmp_path, text, message):
    path = tmp_path / "my_laws.py"
    path.write_text(text)
    with pytest.raises((ModelError, ValidationError), match=message):
        load_laws(path)
    with pytest.raises(DataError, match=r"nowhere\.py: the file of laws cannot be read"):
        load_laws(tmp_path / "nowhere.py")


def test_a_kind_that_is_not_known_says_what_to_give(file, run):
    wrong = run.refused("fit", table(file), "--element", "unheard")
    assert "expected a law from a file given with --laws, or one of " in wrong


def test_a_changed_file_is_run_again(file):
    (before, _) = load_laws(file)
    assert load_laws(file)[0] is before
    file.write_text(LAW.format(kind=kind_of(file), factor=2.0))
    (after, _) = load_laws(file)
    assert KINDS[kind_of(file)] is after is not before
    stiffness = [law(3.0, 1.0).dynamic_stiffness(1e-3).real for law in (before, after)]  # type: ignore[call-arg]
    assert stiffness == pytest.approx([3.0, 6.0])


def test_pickles_bring_it_to_a_process_that_has_not_seen_it(file):
    (law, _) = load_laws(file)
    gap = di.Backlash(law(3.0, f_max=None, name="joint"), 0.1)  # type: ignore[call-arg]
    plant = gap + law(5.0, 1.0) + di.Mass(0.3)  # type: ignore[call-arg]
    assert repr(pickle.loads(pickle.dumps(plant))) == repr(copy.deepcopy(plant)) == repr(plant)
    content = pickle.dumps(law(3.0, 1.0))  # type: ignore[call-arg]
    file.unlink()  # the content goes along; the folder need not be there
    code = "import pickle, sys; print(f'{pickle.load(sys.stdin.buffer).gain(1e-3):.9f}')"
    done = subprocess.run([sys.executable, "-c", code], input=content, capture_output=True)
    assert (done.stdout, done.stderr) == (b"3.000000000\n", b"")


def test_a_pool_of_processes_samples_it(file):
    data = di.read_frequency_response(table(file))
    (law, _) = load_laws(file)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        found = di.posterior(data, law(), seed=1, steps=40, pool=pool)
    assert found.params["k"].value == pytest.approx(30.0, rel=0.05)


def test_a_saved_fit_says_which_file_it_needs(file, monkeypatch):
    data, kind = di.read_frequency_response(table(file)), kind_of(file)
    (law, _) = load_laws(file)
    text = di.fit(data, law()).to_json()
    assert json.loads(text)["laws"] == [
        {"kind": kind, "class": "Jenkins", "module": "my_laws", "file": str(file)}
    ]
    assert di.FitResult.from_json(text).model.elements[0].kind == kind
    monkeypatch.delitem(KINDS, kind)
    said = f"the class Jenkins of {file}; import my_laws first, or give that file with --laws"
    with pytest.raises(ModelError, match=said):
        di.FitResult.from_json(text)
    file.write_text(LAW.format(kind=kind, factor=2.0))
    load_laws(file)
    with pytest.raises(DataError, match="does not give the residuals that the fit was saved with"):
        di.FitResult.from_json(text)


def test_a_saved_fit_of_records_says_it_too(file, monkeypatch):
    (law, _) = load_laws(file)
    t = np.arange(60) / 20.0
    x = 1e-2 * np.sin(5.0 * t) * np.cos(0.7 * t)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(60)
    force = law(30.0, 0.1).force(x) + noise  # type: ignore[call-arg]
    fit = di.fit(di.Record(t, displacement=x, force=force), law())
    text = fit.to_json()
    assert di.FitResult.from_json(text).params["k"].value == fit.params["k"].value
    monkeypatch.delitem(KINDS, kind_of(file))
    with pytest.raises(ModelError, match=f"the class Jenkins of {file}"):
        di.FitResult.from_json(text)


def test_a_campaign_takes_it_to_its_workers(file, run):
    folder, kind = file.parent, kind_of(file)
    table(file).rename(folder / "d0.csv")
    table(file)
    lab = folder / "lab.toml"
    lab.write_text(
        f'laws = "my_laws.py"\n[files]\npattern = "{{device}}.csv"\nkind = "response"\n'
        f'[[model]]\nkind = "{kind}"\n[output]\nfolder = "results"\n'
    )
    KINDS.pop(kind)
    done = run("campaign", str(lab), "--jobs", "2")
    assert (done.status, "2 to do; 2 trusted" in done.out) == (0, True)
    file.write_text(LAW.format(kind=kind, factor=2.0))
    assert "laws was" in run.refused("campaign", lab)
    redone = di.campaign(lab, jobs=1, redo=True)
    assert redone.table["k"].to_numpy() == pytest.approx([15.0, 15.0], rel=0.02)
    lab.write_text(f"laws = 3\n{lab.read_text().partition(chr(10))[2]}")
    with pytest.raises(DataError, match="laws is 3; expected the path of a Python file, or a list"):
        di.campaign(lab)


def test_a_module_that_is_imported_and_given_is_one_law(file, monkeypatch):
    monkeypatch.syspath_prepend(str(file.parent))
    module = importlib.import_module("my_laws")
    (law, _) = load_laws(file)
    assert law.__qualname__ == module.Jenkins.__qualname__
    del sys.modules["my_laws"]
