"""The command line: what it prints, what it writes, how it ends."""

import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import dahl_ident as di
from dahl_ident.errors import DataError
from dahl_ident.synthetic import Experiment

COMMANDS = (
    "demo", "app", "inspect", "extract", "fit", "sample", "plan", "campaign", "report", "export",
    "simulate", "datasets", "template",
)  # fmt: skip
NOISY = (Path(__file__).parents[1] / "datasets/synthetic/noisy.csv").read_text("utf-8")
PROGRAM = Path(sys.executable).with_name("dahl-ident")


def test_command_line_and_python_give_the_same_numbers(run):
    whole = json.loads(run("fit", "-", "--json", stdin=NOISY).out)
    told = whole["params"]
    Path("noisy.csv").write_text(NOISY, encoding="utf-8")
    fit = di.fit(di.read_frequency_response("noisy.csv"), di.Dahl())
    for name in ("f_max", "sigma"):
        assert told[name]["value"] == fit.params[name].value
        assert told[name]["stderr"] == fit.params[name].stderr
        assert whole["budget"]["parameters"][name]["U"] == fit.budget()[name].U
    alpha = whole["assumed"]["alpha"]
    assert f"(here {alpha['value']:.3f} ± {alpha['stderr']:.3f})" in fit.verdict


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fit", "-", "--mass", "heavy"), "mass is 'heavy'; expected a number in SI units"),
        (("fit", "-", "--mass", "3blorp"), "mass is '3blorp': [blorp] is not a known unit"),
        (("simulate", "--f-max", "1", "-o", "x.csv"), "no value for sigma"),
        (
            ("simulate", "--f-max", "1", "--sigma", "2", "--levels", "a:b:c"),
            "levels is 'a:b:c'; expected numbers",
        ),
        (("datasets", "nosy"), "did you mean 'noisy'?"),
        (("template", "reprot"), "did you mean 'report'?"),
        (("sample", "-", "--prior", "fmax=1:2"), "did you mean 'f_max'?"),
        (("fit", "-", "--start", "sgma=1"), "did you mean 'sigma'?"),
        (("datasets", "nosuch"), "there is no data set 'nosuch'; there are"),
        (("datasets", "-o", "x.csv"), "--output needs the name of a data set"),
        (("sample", "-", "--prior", "f_max"), "prior is 'f_max'; expected a name and two bounds"),
        (("fit", "."), "error: . is a folder; give the path of a file in it"),
        (("fit", "-", "--config", "absent.toml"), "absent.toml is not a TOML file of options"),
        (("fit", "-", "--save", "fit.txt"), "fit.txt: a fit is written as .json; got '.txt'"),
        (("fit", "-", "--report", "r.docx"), "r.docx: a report is written as .html, .pdf"),
        (("sample", "-", "--report", "r"), "r: a report is written as"),
        (("report", "-", "-o", "-", "--json"), "more than one output goes to standard output"),
        (("report", "-", "-o", "-", "-o", "-"), "more than one output goes to standard output"),
        (("fit", "-", "--start", "f_max=much"), "start of f_max is 'much'; expected a number"),
        (("fit", "-", "--delay", "soon"), "delay is 'soon'; expected a number"),
        (("fit", "-", "--force-gain", "nrm(1,2)"), "expected a distribution of scipy.stats"),
        (("fit", "-", "--force-gain", "norm(1,a)"), "which are not arguments of norm"),
        (
            ("fit", "-", "--force-gain", "norm(1)"),
            "leaves out the scale; expected norm(loc, scale)",
        ),
        (
            ("sample", "-", "--prior", "sigma=lognorm(0.1)"),
            "leaves out the scale; expected lognorm(s, loc, scale)",
        ),
        (("fit", "-", "--force-gain", "norm(1,0)"), "has no finite mean or no width"),
        (("report", "-", "--bootstrap", "--seed", "-2"), "error: seed is -2; expected a whole num"),
        (("simulate", "--f-max", "1", "--sigma", "3", "--seed", "-1"), "error: seed is -1; expec"),
        (("report", "-", "-o", "a.doc"), "a.doc: a report is written as"),
    ],
)
def test_bad_input_says_what_was_expected_and_writes_nothing(run, arguments, message):
    assert message in run.refused(*arguments, stdin=NOISY)
    assert list(Path().iterdir()) == []


def test_a_fit_that_runs_away_ends_with_3_and_says_why(run):
    amplitude = np.geomspace(1e-6, 1e-5, 8)
    response = np.full(8, 30.0 + 0.0j) * np.exp(1j * 1e-3 * ((-1.0) ** np.arange(8) - 0.5))
    di.FrequencyResponse(np.ones(8), response, amplitude).save("stuck.csv")
    outcome = run("fit", "stuck.csv", "--noise", "relative")
    assert outcome.status == 3
    assert "not to be trusted: " in outcome.err
    assert "f_max" in outcome.out


def test_points_that_are_not_good_end_with_3(run):
    record = run("datasets", "unsettled", "-o", "-").out
    outcome = run("extract", "-", "-o", "levels.csv", stdin=record)
    assert outcome.status == 3
    assert re.search(r"not to be trusted: \d+ of \d+ points are not good \(point \d+: not settled",
                     outcome.err)  # fmt: skip
    assert di.read_frequency_response("levels.csv").n > 0


def test_options_come_from_a_file_and_the_command_line_wins(run):
    Path("noisy.csv").write_text(run("datasets", "noisy", "-o", "-").out, encoding="utf-8")
    Path("lab.toml").write_text(
        'sigma = "40"\n[fit]\nnoise = "relative"\njson = true\n[datasets]\nname = "x"\n',
        encoding="utf-8",
    )
    params = json.loads(run("fit", "noisy.csv", "--config", "lab.toml").out)["params"]
    assert params["sigma"] == params["sigma"] | {"value": 40.0, "vary": False}
    again = run("fit", "noisy.csv", "--config", "lab.toml", "--sigma", "20").out
    assert json.loads(again)["params"]["sigma"]["value"] == 20.0


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("[fit]\nnosie = 1\n", "fit has no option nosie; there are "),
        ('nosie = "absolute"\n', "no command has the option nosie; there are "),
        (
            '[fti]\nnoise = "absolute"\n',
            "no command is called fti; there are app, campaign, datasets, ",
        ),
        ("fti = 3\n", "no command has the option fti; "),
        ("fit = 3\n", "no command has the option fit; "),
        ("[sample]\npriro = 3\n", "sample has no option priro; there are "),
    ],
)
def test_an_unknown_name_in_a_file_of_options_is_refused(run, options, says):
    Path("lab.toml").write_text(options, encoding="utf-8")
    error = run.refused("fit", "x.csv", "--config", "lab.toml")
    assert error.startswith(f"error: lab.toml: {says}")


def test_a_report_shows_how_waveforms_settled(run):
    Path("run.csv").write_text(run("datasets", "plant_recording", "-o", "-").out, encoding="utf-8")
    assert run("extract", "run.csv", "--controlled", "force", "-o", "levels.csv").status == 0
    plant = ("--mass", "free", "--damping", "free", "--stiffness", "free")
    told = run("report", "levels.csv", *plant, "--waveforms", "run.csv", "-o", "a.html")
    assert told.status == 0, told.err
    assert "which has the largest ratio of bias to error" in Path("a.html").read_text(
        encoding="utf-8"
    )
    Path("columns.toml").write_text("[time]\ncolumn = 'clock'\n", encoding="utf-8")
    wrong = run.refused("report", "levels.csv", *plant, "--waveforms", "run.csv",
                        "--waveforms-columns", "columns.toml", "-o", "b.html")  # fmt: skip
    assert "no column is called 'clock'" in wrong
    assert not Path("b.html").exists()


def test_levels_come_from_file_names(run):
    amplitude = np.geomspace(1e-4, 1e-2, 6)
    stiffness = di.Dahl(0.1, 30.0).describing_function(amplitude)
    for level, N in zip(("0.1", "0.2", "0.3"), stiffness[::2], strict=True):
        text = f"frequency_hz,gain [N/m],phase_deg\n1,{abs(N)},{np.degrees(np.angle(N))}\n"
        Path(f"run_{level}mm.csv").write_text(text, encoding="utf-8")
    outcome = run(
        "fit", "run_0.1mm.csv", "run_0.2mm.csv", "run_0.3mm.csv", "--json",
        "--level-from-name", "_([0-9.]+)mm", "--amplitude", "{level} mm",
    )  # fmt: skip
    assert json.loads(outcome.out)["params"]["f_max"]["value"] > 0.0


def test_simulate_prints_an_experiment_that_it_reads(run):
    options = ("simulate", "--f-max", "0.1", "--sigma", "30", "--levels", "1e-3,2e-3")
    text = run(*options).out
    assert Experiment.from_toml(text).truth["sigma"] == 30.0
    Path("run.toml").write_text(text, encoding="utf-8")
    assert run("simulate", "run.toml", "-o", "a.csv").status == 0
    assert run(*options, "-o", "b.csv").status == 0
    assert Path("a.csv").read_bytes() == Path("b.csv").read_bytes()
    assert tomllib.loads(text)["excitation"]["levels"] == [1e-3, 2e-3]


def test_noise_is_a_share_of_a_table_and_has_the_unit_of_samples(run):
    plant = ("simulate", "--f-max", "2.4N", "--sigma", "5.2N/mm")
    shown = run(*plant, "--force-std", "0.5 %", "--json")
    assert json.loads(shown.out)["table"]["force_std"] == 0.005
    shown = run(*plant, "--force-std", "5mN", "--displacement-std", "0.1um", "--record", "--json")
    sensors = json.loads(shown.out)["acquisition"]
    assert sensors["force"]["noise_std"] == 5e-3
    assert sensors["displacement"]["noise_std"] == pytest.approx(1e-7)
    assert "--force-std is '5mN'; expected a share" in run(*plant, "--force-std", "5mN").err
    assert "such as 5e-6 or 5uN" in run(*plant, "--force-std", "1 %", "--record").err


def test_a_record_is_simulated_inspected_and_extracted(run):
    made = run(
        "simulate", "--f-max", "0.1", "--sigma", "30", "--record", "--levels", "2e-3,8e-3",
        "--force-std", "1e-4", "--settling-periods", "20", "-o", "run.csv",
    )  # fmt: skip
    assert made.status == 0, made.err
    contents = json.loads(run("inspect", "run.csv", "--json").out)
    assert [c["name"] for c in contents[0]["channels"]] == ["time", "displacement", "force"]
    outcome = run(
        "extract", "run.csv", "-o", "points.csv", "--plot", "points.png", "--harmonics", "1"
    )
    assert outcome.status in (0, 3), outcome.err
    points = di.read_frequency_response("points.csv")
    exact = di.Dahl(0.1, 30.0).describing_function(points.amplitude)
    np.testing.assert_allclose(points.response, exact, rtol=0.02)
    assert Path("points.png").read_bytes().startswith(b"\x89PNG")


def test_a_proposed_column_map_is_written_and_read(run):
    Path("own.csv").write_text(
        "Freq (Hz),Disp [um],Gain [N/um],Phase [deg]\n"
        "2,20,0.038,9.7\n2,200,0.011,59\n2,900,0.003,75\n"
    )
    assert "(inspect proposes a column map)" in run.refused("fit", "own.csv")
    assert run("inspect", "own.csv", "-o", "columns.toml").status == 0
    assert run("inspect", "own.csv", "-o", "columns.toml").status == 1, "nothing is overwritten"
    assert run("fit", "own.csv", "--columns", "columns.toml").status in (0, 3)
    Path("other.csv").write_text("f [Hz],A [m],gain [N/m],phase [deg]\n2,2e-5,0.038,9.7\n")
    different = run("inspect", "own.csv", "other.csv", "-o", "both.toml")
    assert different.status == 2
    assert "own.csv and other.csv need different column maps" in different.err


def test_extraction_of_several_files_names_levels_and_files(run):
    for level in ("2e-3", "8e-3"):
        run("simulate", "--f-max", "0.1", "--sigma", "30", "--record", "--levels", level,
            "--force-std", "1e-4", "-o", f"run_{level}m.csv")  # fmt: skip
    files = ["run_2e-3m.csv", "run_8e-3m.csv"]
    told = run("extract", *files, "--level-from-name", r"run_(.*)m", "--harmonics", "3")
    assert told.status == 0, told.err
    levels = [line.split()[0] for line in told.out.splitlines() if "good" in line]
    assert levels == ["0.002", "0.008"]
    Path("flat.csv").write_text("time [s],x [m],F [N]\n0,1,2\n1,1,2\n2,1,2\n")
    refused = run.refused("extract", *files, "flat.csv")
    assert "flat.csv: no segment of constant amplitude" in refused


def test_no_good_point_is_an_error_of_its_own(run):
    run("simulate", "--f-max", "0.1", "--sigma", "30", "--record", "--levels", "1e-4",
        "--force-std", "1e-6", "-o", "run.csv")  # fmt: skip
    table = Path("run.csv").read_text().replace("force [N]", "minus force [N]")
    Path("turned.csv").write_text(table)
    turned = (
        'time = "time"\ndisplacement = "displacement"\n[force]\ncolumn = "minus force"\nsign = -1\n'
    )
    Path("lab.toml").write_text(turned)
    outcome = run("extract", "turned.csv", "--columns", "lab.toml", "--good-only")
    assert outcome.status == 1
    assert "creates energy: a sign is reversed" in outcome.err
    assert "no point is good" in outcome.err


def test_sample_integrates_at_once_where_asked(run):
    options = ("sample", "-", "--prior", "f_max=0.01:1", "--alpha", "1")
    told = json.loads(run(*options, "--method", "grid", "--json", stdin=NOISY).out)
    assert told["converged"]
    assert told["error"] < 1e-3
    chain = json.loads(run(*options, "--json", stdin=NOISY).out)
    for name in ("f_max", "sigma"):
        exact, drawn = told["summary"][name], chain["summary"][name]
        assert abs(exact["median"] - drawn["median"]) < 0.1 * exact["std"]
    text = run(*options, "--method", "grid", stdin=NOISY)
    assert text.status == 0
    assert text.out.startswith("Converged: error ")
    assert "ln evidence: " in text.out
    refused = run.refused(*options, "--method", "grid", "--max-steps", "30", stdin=NOISY)
    assert "--max-steps given with --method grid, which has no such option" in refused


def test_a_saved_fit_is_sampled_with_its_model(run):
    run("fit", "-", "--alpha", "1", "--save", "fit.json", stdin=NOISY)
    options = ("--method", "grid", "--json")
    saved = json.loads(run("sample", "fit.json", *options).out)
    told = json.loads(run("sample", "-", "--alpha", "1", *options, stdin=NOISY).out)
    assert saved["summary"] == told["summary"]
    refused = run.refused("sample", "fit.json", "--alpha", "1")
    assert "a saved fit has its data and model; give no options of these" in refused


def test_a_chain_that_is_too_short_ends_with_3(run):
    outcome = run("sample", "-", "--steps", "20", "--alpha", "1", stdin=NOISY)
    assert outcome.status == 3
    assert outcome.out.startswith("NOT CONVERGED after 20 steps")


def test_a_prior_that_keeps_the_data_out_ends_with_3(run):
    options = ("--method", "grid", "--prior", "f_max=1:2", "--uncertainty", "noise")
    outcome = run("sample", "-", *options, stdin=NOISY)
    assert outcome.status == 3
    assert outcome.err.startswith("not to be trusted: PRIOR AGAINST DATA: f_max lies beyond 99 %")
    assert "MISFIT: the residuals are larger than the noise that the data state" in outcome.out


def test_report_writes_every_format_asked_for(run):
    outcome = run("report", "-", "-o", "a.html", "-o", "a.json", stdin=NOISY)
    assert outcome.out.split() == ["a.html", "a.json"]
    assert json.loads(Path("a.json").read_text(encoding="utf-8"))["trusted"] is True


@pytest.mark.parametrize("command", COMMANDS)
def test_every_help_has_an_example_that_runs(run, command):
    help_text = " ".join(re.sub("[│╭╮╰╯]", " ", run(command, "--help").out).split())
    found = re.search(r"Example: (dahl-ident .*?)(?= (?:Arguments|Options|Ends) |─|$)", help_text)
    assert found, help_text
    if command in ("demo", "app"):
        return  # run by make demo and the test of the chain; by the tests of the page
    if command == "campaign":
        run("datasets", "noisy", "-o", "device.csv")
        Path("campaign.toml").write_text(
            '[files]\npattern = "{device}.csv"\nkind = "response"\n[[model]]\nkind = "dahl"\n'
        )
    if command == "export":
        run("fit", "-", "--save", "fit.json", stdin=NOISY)
    run.line(found[1].strip(), *(("--alpha", "1") if command == "sample" else ()))


@pytest.mark.versions
def test_help_lists_all_commands(run):
    text = run("--help").out
    assert [name for name in COMMANDS if name not in text] == []
    Path("options.toml").write_text("[nosuch]\nnoise = 1\n")
    said = run("fit", "x.csv", "--config", "options.toml").err
    (there,) = re.findall(r"there are (.+)", " ".join(said.split()))
    assert re.findall(r"[a-z]+", there)[: len(COMMANDS)] == sorted(COMMANDS)


@pytest.mark.versions
def test_no_colour_off_a_terminal(run):
    assert "\x1b[" not in run("datasets").out + run("--no-color", "datasets").out


def loaded_modules(*arguments):
    """Return the modules that are loaded after a command."""
    code = (
        "import sys\nfrom dahl_ident.cli import main\n"
        f"try:\n    main({list(arguments)!r})\nexcept SystemExit:\n    pass\n"
        "print('loaded', *sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return set(out.stdout[out.stdout.rindex("loaded") :].split())


@pytest.mark.versions
def test_help_loads_nothing_heavy():
    heavy = {"numpy", "scipy", "matplotlib", "pandas", "casadi", "emcee", "pint"}
    assert not loaded_modules("fit", "--help") & heavy


@pytest.mark.parametrize("extracted", [False, True])
def test_a_fit_of_a_small_table_loads_nothing_that_takes_long(tmp_path, *, extracted):
    """Also of one with runs, truth values and verdicts, as `extract` writes them."""
    table = tmp_path / "noisy.csv"
    data: Any = di.load_dataset("noisy")
    if extracted:
        quality = {"settled": np.arange(data.n) != 3, "verdict": ["good", "distorted 11 %"] * 15}
        runs = np.array([f"day_{i % 3}_0.5in" for i in range(data.n)])
        data = replace(data, run=runs, quality=quality)
    data.save(table)
    again = di.read_frequency_response(table)
    for name in again.quality:
        assert np.array_equal(again.quality[name], data.quality[name])
    heavy = {"matplotlib", "pandas", "casadi", "emcee", "pint", "scipy.stats", "control", "h5py"}
    assert loaded_modules("fit", str(table), "-q") & (heavy | {"scipy.interpolate"}) == set()


def test_a_saved_fit_is_reported_with_its_posterior(run):
    assert run("fit", "-", "--alpha", "1", "--save", "fit.json", stdin=NOISY).status == 0
    assert run("report", "fit.json", "--posterior", "-o", "r.json").status == 0
    told = json.loads(Path("r.json").read_text(encoding="utf-8"))
    assert told["posteriors"][0]["converged"] is True
    assert told["posteriors"][0]["seed"] == 1
    assert told["fits"][0]["parameters"]["f_max"]["value"] == pytest.approx(0.1, rel=0.02)


def test_a_chain_goes_on_from_its_file(run):
    Path("noisy.csv").write_text(run("datasets", "noisy", "-o", "-").out, encoding="utf-8")
    options = ("sample", "noisy.csv", "--alpha", "1", "--json")
    first = json.loads(run(*options, "--resume", "chain.h5", "--steps", "30").out)
    second = json.loads(run(*options, "--resume", "chain.h5", "--steps", "60").out)
    whole = json.loads(run(*options, "--steps", "60").out)
    assert (first["steps"], second["steps"]) == (30, 60)
    assert second["summary"]["sigma"]["mean"] == whole["summary"]["sigma"]["mean"]


@pytest.mark.versions
def test_the_status_is_coloured_on_a_terminal_unless_no_color(tmp_path):
    pty = pytest.importorskip("pty", reason="terminals are POSIX")
    table = tmp_path / "noisy.csv"
    di.load_dataset("noisy").save(table)
    for extra, coloured in (({}, True), ({"NO_COLOR": "1"}, False)):
        ours, theirs = pty.openpty()
        process = subprocess.Popen(
            [str(PROGRAM), "fit", str(table)], stdout=theirs, stderr=theirs,
            env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", **extra},
        )  # fmt: skip
        os.close(theirs)
        out = b""
        while True:
            try:
                part = os.read(ours, 4096)
            except OSError:  # the way a terminal says that it is closed
                break
            if not part:
                break
            out += part
        process.wait(timeout=60)
        os.close(ours)
        green = re.search(rb"\x1b\[[0-9;]*32m *Trusted\x1b\[0m\.", out) is not None
        assert green == coloured
        assert b"f_max" in out


def test_a_progress_bar_stays_out_of_the_results(tmp_path):
    pty = pytest.importorskip("pty", reason="terminals are POSIX")
    table = tmp_path / "noisy.csv"
    di.load_dataset("noisy").save(table)
    ours, theirs = pty.openpty()
    done = subprocess.run(
        [str(PROGRAM), "sample", str(table), "--alpha", "1", "--steps", "30", "--json"],
        stdout=subprocess.PIPE, stderr=theirs, env={**os.environ, "TERM": "xterm-256color"},
    )  # fmt: skip
    os.close(theirs)
    bar = os.read(ours, 65536)
    os.close(ours)
    assert b"sampling" in bar
    assert json.loads(done.stdout)["steps"] == 30


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_full_disk_behind_standard_output_is_one_line(unbuffered):
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [str(PROGRAM), "datasets", "noisy", "-o", "-"],
            stdout=full, stderr=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
    assert ended.returncode == 1
    assert ended.stderr == "error: standard output: No space left on device\n"


def test_a_closed_standard_input_is_named(monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(DataError, match="standard input is closed; pipe the file into it"):
        di.read_frequency_response("-")


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        ("da", "datasets"),
        ("datasets noi", "noisy"),
        ("fit --method ip", "ipopt"),
        ("export fit.json --to mujoco-", "mujoco-frictionloss"),
        ("template op", "options"),
    ],
)
def test_the_shell_completes_commands_and_values(run, monkeypatch, words, completed):
    typed = f"dahl-ident {words}"
    monkeypatch.setenv("_DAHL_IDENT_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split()) - 1))
    assert run().out.split() == [completed]


def test_every_template_is_read_by_its_option(run):
    for name in ("report", "options", "columns", "campaign"):
        assert run("template", name, "-o", f"{name}.toml").status == 0
    assert run("template", "report").out == Path("report.toml").read_text(encoding="utf-8")
    noise = np.random.default_rng(1)
    table = "f [Hz],x [um],K,phi\n" + "".join(
        f"1,{1e6 * A},{1e-3 * abs(N)},{np.degrees(np.angle(N))}\n"
        for A in np.geomspace(1e-3, 3e-2, 12)
        for N in [complex(di.Dahl(0.1, 30.0).describing_function([A])[0] * noise.normal(1.0, 1e-3))]
    )
    Path("data/pivot").mkdir(parents=True)
    Path("data/pivot/one.csv").write_text(table, encoding="utf-8")
    read = ("fit", "data/pivot/one.csv", "--columns", "columns.toml", "--json")
    fitted = json.loads(run(*read, "--metadata", "report.toml").out)["params"]
    assert fitted["f_max"]["value"] == pytest.approx(0.1, rel=0.01)
    assert fitted["force_gain"]["stderr"] == pytest.approx(0.0025, rel=0.01)
    assert fitted["displacement_gain"]["stderr"] == pytest.approx(0.001, rel=0.01)
    optioned = json.loads(run(*read, "--noise", "relative", "--config", "options.toml").out)
    assert optioned["params"]["mass"]["value"] == pytest.approx(0.3)
    listed = run("campaign", "campaign.toml", "--dry-run")
    assert "to do: pivot" in listed.out, listed.err


def test_quantities_take_their_unit(run):
    plant = ("--f-max", "100mN", "--sigma", "0.03N/mm", "--mass", "300g")
    drive = ("--controlled", "force", "--levels", "50:200mN:9", "--frequency", "1,2Hz")
    assert run("simulate", *plant, *drive, "-o", "plant.csv").status == 0
    data = di.read_frequency_response("plant.csv")
    assert sorted(set(data.frequency_hz)) == [1.0, 2.0]
    assert data.drive.min() == pytest.approx(0.05)
    assert data.drive.max() == pytest.approx(0.2)
    fit = ("fit", "plant.csv", "--json", "--noise", "relative", "--mass", "0.3kg")
    params = json.loads(run(*fit, "--f-max", "0.1 N").out)["params"]
    assert (params["mass"]["value"], params["f_max"]["vary"]) == (pytest.approx(0.3), False)
    assert params["sigma"]["value"] == pytest.approx(30.0, rel=1e-6)


def test_quiet_leaves_errors_and_what_goes_to_standard_output(run):
    table = run("datasets", "noisy", "-o", "-", "--quiet").out
    assert "frequency_hz" in table
    told = run("fit", "-", "--quiet", "--save", "f.json", "--report", "r.html", stdin=table)
    assert (told.status, told.out, told.err) == (0, "", "")
    assert json.loads(run("fit", "-", "-q", "--json", stdin=table).out)["trusted"]
    assert run("fit", "absent.csv", "-q").err.startswith("error: absent.csv")
    assert run("fit", "-", stdin=table).out, "the next command prints again"


def test_lists_keep_to_a_narrow_terminal(run, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    assert max(map(len, run("datasets").out.splitlines())) <= 60


WRITING = {
    "datasets": ("there.csv", ("noisy", "-o", "there.csv")),
    "simulate": ("there.csv", ("--f-max", "0.1", "--sigma", "30", "-o", "there.csv")),
    "extract": ("there.png", ("-", "--plot", "there.png")),
    "fit": ("there.json", ("-", "--save", "there.json")),
    "report": ("there.html", ("-", "-o", "new.json", "-o", "there.html")),
    "sample": ("there.json", ("-", "--steps", "20", "--report", "there.json")),
    "demo": ("levels.csv", ("-o", ".")),
}


@pytest.mark.parametrize("command", WRITING)
def test_an_existing_file_is_replaced_on_request_only(run, command):
    existing, arguments = WRITING[command]
    Path(existing).write_text("mine", encoding="utf-8")
    error = run.refused(command, *arguments)
    assert error.startswith(f"error: {existing}: the file exists already")
    assert "--overwrite" in error
    assert [p.name for p in Path().iterdir()] == [existing]
    assert Path(existing).read_text(encoding="utf-8") == "mine"


def test_overwrite_replaces(run):
    Path("noisy.csv").write_text("mine", encoding="utf-8")
    assert run("datasets", "noisy", "-o", "noisy.csv", "--overwrite").status == 0
    assert di.read_frequency_response("noisy.csv").n > 10
    for _ in range(2):
        ended = run("fit", "noisy.csv", "--save", "f.json", "--report", "r.json", "--overwrite")
        assert ended.status == 0, ended.err
    assert di.FitResult.load("f.json").trusted


@pytest.mark.parametrize("option", ["--save", "--report"])
def test_an_input_is_never_written_over(run, option):
    assert run("datasets", "noisy", "-o", "noisy.csv").status == 0
    before = Path("noisy.csv").read_bytes()
    refused = run.refused("fit", "noisy.csv", option, "./noisy.csv")
    assert "noisy.csv is an input and would be overwritten" in refused
    assert Path("noisy.csv").read_bytes() == before


def test_a_report_goes_to_standard_output(run):
    out = run("fit", "-", "--report", "-", stdin=NOISY).out
    assert out.startswith("<!doctype html>")
    assert out.rstrip().endswith("</html>")
    assert list(Path().iterdir()) == []


def test_sensors_are_fixed_free_or_have_a_prior(run):
    Path("noisy.csv").write_text(run("datasets", "noisy", "-o", "-").out, encoding="utf-8")
    Path("lab.toml").write_text(
        'force_gain = "scipy.stats.norm(1, 0.05)"\ndelay = 1e-4\n', encoding="utf-8"
    )
    params = json.loads(run("fit", "noisy.csv", "--json", "--config", "lab.toml").out)["params"]
    sensors = di.Sensors(force_gain=stats.norm(1, 0.05), delay=1e-4)
    fit = di.fit(di.read_frequency_response("noisy.csv"), di.Dahl(), sensors=sensors)
    for name in ("f_max", "sigma", "force_gain", "delay"):
        assert params[name]["value"] == pytest.approx(fit.params[name].value, rel=1e-6)
        expected = fit.params[name].stderr
        assert params[name]["stderr"] == (expected and pytest.approx(expected, rel=1e-4))
    assert params["force_gain"]["vary"]
    outcome = run("fit", "noisy.csv", "--force-gain", "free")
    assert outcome.status == 3
    assert "give force_gain a prior" in outcome.out


def test_priors_come_from_a_calibration_sheet(run):
    Path("lab.toml").write_text(
        "[sample]\nsteps = 60\n[sample.prior]\nf_max = ['10mN', '1N']\n"
        'sigma = "lognorm(s=0.1, scale=30)"\n',
        encoding="utf-8",
    )
    told = json.loads(run("sample", "-", "--json", "--config", "lab.toml", stdin=NOISY).out)
    assert told["priors"]["f_max"].startswith("log-uniform from 0.01 to 1 N")
    assert told["priors"]["sigma"].startswith("lognorm, mean 30.15")


def test_a_saved_fit_takes_no_other_model(run):
    assert run("fit", "-", "--save", "fit.json", stdin=NOISY).status == 0
    refused = run.refused("report", "fit.json", "--mass", "free", "-o", "r.html")
    assert "saved fits are reported unchanged" in refused


def test_a_comparison_is_printed_once(run):
    table = run("datasets", "alpha_2", "-o", "-").out
    told = run("fit", "-", "-v", "--compare", stdin=table).out
    assert len(re.findall(r"^ *model +reason ", told, re.MULTILINE)) == 1


def test_warnings_are_in_the_short_output(run):
    table = run("datasets", "fig_7_plant", "-o", "-").out
    plant = ("--mass", "0.3", "--damping", "free", "--stiffness", "free")
    told = run("fit", "-", *plant, "--steady", "describing function", stdin=table).out
    assert re.search(r"Warning: the describing function, .* fit with --steady exact\.", told)
    assert "Warning" not in run("fit", "-", *plant, stdin=table).out
