"""The package as its users meet it: its names, its weight, its wheel."""

import ast
import inspect
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections import Counter
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

import dahl_ident as di

ROOT = Path(__file__).parents[1]

PUBLIC_NAMES = [
    "Backlash", "BoucWen", "Dahl", "Damper", "Element", "Experiment", "FitResult",
    "FrequencyResponse", "Friction", "Iwan", "LinearSystem", "LuGre", "Mass", "MaxwellSlip",
    "Model", "Parameter", "PowerDamper", "Record", "Sensors", "Spring", "campaign",
    "compare_models", "control", "errors", "extract", "fit", "fit_many", "load_dataset", "plan",
    "population", "posterior", "read_frequency_response", "read_record", "report", "response",
    "simulate", "synthetic",
]  # fmt: skip


# of numpy, pandas and the standard library, protocols, aliases, and what functions return
USUAL = {
    *("Any", "ArrayLike", "Callable", "DataFrame", "Iterable", "Mapping", "Path", "PathLike"),
    *("Sequence", "ComparableFit", "Result", "Records"),
}


def test_public_names_are_frozen():
    assert sorted(di.__all__) == PUBLIC_NAMES


def test_no_two_classes_share_a_name():
    files = (ROOT / "dahl_ident").rglob("*.py")
    nodes = (node for file in files for node in ast.walk(ast.parse(file.read_text("utf-8"))))
    names = Counter(n.name.lstrip("_") for n in nodes if isinstance(n, ast.ClassDef))
    assert [name for name, count in names.items() if count > 1] == []


def test_rooms_are_reached_through_the_package():
    assert di.control.limit_cycles.__module__.startswith("dahl_ident.control_interop")
    assert di.synthetic.SteppedSine.__doc__
    assert issubclass(di.errors.FitError, di.errors.DahlIdentError)


def test_what_a_signature_needs_is_where_the_function_is():
    rooms = [di, di.control, di.synthetic]
    for room in rooms:
        for name in room.__all__:
            function = getattr(room, name)
            if not inspect.isfunction(function):
                continue
            for parameter in inspect.signature(function).parameters.values():
                if parameter.default is not inspect.Parameter.empty:
                    continue
                needed = set(re.findall(r"\b[A-Z][A-Za-z]+", str(parameter.annotation)))
                missing = {n for n in needed - USUAL if not (hasattr(room, n) or hasattr(di, n))}
                assert not missing, f"{name}({parameter}) needs {missing}"


@pytest.mark.parametrize("name", PUBLIC_NAMES)
@pytest.mark.versions
def test_every_public_name_loads_and_is_documented(name):
    value = getattr(di, name)
    assert name in dir(di)
    assert value.__doc__


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'dahl_ident' has no attribute 'dahl'"):
        di.dahl  # noqa: B018 - the access is the test


@pytest.mark.versions
def test_import_loads_no_heavy_library():
    code = "import sys, dahl_ident; print(' '.join(sys.modules))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout.split()
    heavy = {"scipy", "matplotlib", "casadi", "emcee", "control", "pandas", "pint", "typer", "h5py"}
    assert not {*heavy, "numba"} & set(loaded)


@pytest.mark.versions
def test_fitting_a_table_loads_only_what_it_needs():
    code = "import sys, dahl_ident; dahl_ident.fit; print(' '.join(sys.modules))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout.split()
    heavy = {"scipy.signal", "scipy.stats", "scipy.optimize", "matplotlib", "casadi"}
    assert not heavy & set(loaded)


def test_wheel_installs_and_runs_elsewhere(tmp_path):
    uv = [sys.executable, "-m", "uv"]
    build = [*uv, "build", "--quiet", "--wheel", "--out-dir", str(tmp_path), str(ROOT)]
    subprocess.run(build, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    for file in ("py.typed", "app/templates/base.html", "app/static/app.css", "app/static/app.js"):
        assert f"dahl_ident/{file}" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/", "stubs/"))]

    here = tmp_path / "installed"
    install = [*uv, "pip", "install", "--quiet", "--no-deps", "--target", str(here)]
    subprocess.run([*install, str(wheel)], check=True)
    code = (
        "import dahl_ident as di; print(di.__file__); "
        "print(abs(di.Dahl(f_max=1.0, sigma=1.0).describing_function(1.0)).round(5)); "
        "print(di.load_dataset('noisy').n, di.load_dataset('unsettled').n)"
    )
    out = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(here)},
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split()
    assert Path(out[0]).is_relative_to(here)
    assert out[1] == "0.79291"
    assert out[2:] == ["30", "2305"]


def test_the_version_is_the_same_everywhere():
    (cited,) = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    (newest, *_) = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert cited == newest == di.__version__


SECURITY_RELEASES = {  # the first that mends what is public about earlier ones
    "numpy": "1.22", "scipy": "1.10", "pyarrow": "14.0.1", "jinja2": "3.1.6", "h5py": "3.12",
    "pillow": "12.3", "distributed": "2026.1", "fpdf2": "2.5", "openpyxl": "2.4.2",
    "python-multipart": "0.0.22", "starlette": "0.49.1",
}  # fmt: skip


def test_dependencies_begin_at_security_releases_and_pins_meet_them():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [entry for extra in project["optional-dependencies"].values() for entry in extra]
    wanted = [Requirement(entry) for entry in [*project["dependencies"], *extras]]
    for one in wanted:
        if one.name.lower() in SECURITY_RELEASES:
            least = next(Version(part.version) for part in one.specifier if part.operator == ">=")
            assert least >= Version(SECURITY_RELEASES[one.name.lower()]), one.name
    pins: dict[str, list[str]] = {}
    for line in (ROOT / "requirements" / "dev.txt").read_text().splitlines():
        if pin := re.match(r"([\w.-]+)==([^ ]+)", line):
            pins.setdefault(pin[1].lower(), []).append(pin[2])
    names = {one.name.lower().replace("_", "-") for one in wanted} - {"dahl-ident", "numpyro"}
    assert not names - set(pins)
    for one in wanted:
        for version in pins.get(one.name.lower(), []):
            assert one.specifier.contains(version), f"{one} is pinned to {version}"


def test_every_package_that_is_imported_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [entry for extra in project["optional-dependencies"].values() for entry in extra]
    declared = {Requirement(one).name.lower() for one in [*project["dependencies"], *extras]}
    imported = set()
    for path in (ROOT / "dahl_ident").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            match node:
                case ast.Import():
                    imported |= {alias.name.partition(".")[0] for alias in node.names}
                case ast.ImportFrom(module=str(module), level=0):
                    imported.add(module.partition(".")[0])
    known = {"dahl_ident", "typing_extensions", *sys.stdlib_module_names}  # the second: types alone
    bearing = {
        "fpdf": "fpdf2",
        "tomli_w": "tomli-w",
        "PIL": "pillow",
        "python_calamine": "python-calamine",
    }
    assert {bearing.get(name, name).lower() for name in imported - known} <= declared
