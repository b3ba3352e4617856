"""How commands end where they cannot do their work: wrong use, interrupts, pipes, full disks."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import pytest

import dahl_ident as di
from dahl_ident.errors import DataError, SamplingError
from tests.bayes_cases import friction_table

PROGRAM = Path(sys.executable).with_name("dahl-ident")
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="signals and pipes are POSIX")


@pytest.mark.parametrize(
    ("arguments", "found", "command"),
    [
        (("fit",), ("Missing argument", "files"), "fit"),
        (("fit", "-", "--nosuch"), ("--nosuch",), "fit"),
        (("fit", "-", "--frequency", "soon"), ("--frequency", "'soon'"), "fit"),
        (("plan", "--time", "5kg"), ("--time", "[kg]", "dimension of s"), "plan"),
        (("fit", "-", "--loss", "hubr"), ("did you mean 'huber'?",), "fit"),
        (("ft", "-"), ("did you mean 'fit'?",), ""),
        (("fit", "-", "--method", "lmfit"), ("--method", "'lmfit'", "lm, scipy, ipopt"), "fit"),
        (("sample", "-", "--method", "nuts"), ("--method", "'nuts'", "mcmc, grid"), "sample"),
        (("--no-color", "sample", "-", "--steps"), ("--steps", "argument"), "sample"),
        (("sample", "-", "--steps", "1.5"), ("--steps", "integer", "'1.5'"), "sample"),
        (("nosuch",), ("No such command", "nosuch"), ""),
    ],
)
def test_wrong_use_is_two_plain_lines(run, arguments, found, command):
    outcome = run(*arguments)
    assert (outcome.status, outcome.out) == (2, "")
    message, hint = outcome.err.splitlines()
    assert message.startswith("error: ")
    assert [part for part in found if part.lower() not in message.lower()] == []
    assert hint == " ".join(["See dahl-ident", *([command] if command else []), "--help"])
    assert outcome.err.isascii()


def test_nothing_typed_shows_the_help(run):
    outcome = run()
    assert outcome.status == 2
    assert "Usage: dahl-ident" in outcome.out + outcome.err
    assert "error" not in outcome.err


def interrupted(folder, *arguments, when=None):
    """Interrupt a command at work, and return what it printed on both streams.

    Once a file is there, or once it reads its standard input, which then stays open: 100 kB are
    more than a pipe holds.
    """
    with subprocess.Popen(
        [str(PROGRAM), *arguments],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        cwd=folder,
        # the shell of a job in the background has its children ignore interrupts
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:  # fmt: skip
        ends = time.monotonic() + 90.0
        while when is not None and not when.exists() and time.monotonic() < ends:
            time.sleep(0.05)
        if "-" in arguments:
            process.stdin.write(100_000 * "\n")
        time.sleep(0.5 if when or "-" in arguments else 3.0)
        assert process.poll() is None, process.communicate()
        while process.poll() is None:
            assert time.monotonic() < ends, "the command cannot be interrupted"
            process.send_signal(signal.SIGINT)
            # an interrupt that meets a callback of a compiled library is lost: press again
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=5)
        out, err = process.communicate()
    assert process.returncode == 130
    return out, err


@POSIX
def test_an_interrupted_chain_says_how_it_goes_on(tmp_path):
    friction_table().save(tmp_path / "levels.csv")
    endless = ("sample", "levels.csv", "--ess", "1e9", "--max-steps", "1000000", "--json")
    chain = tmp_path / "chain.h5"
    out, err = interrupted(tmp_path, *endless, "--resume", "chain.h5", when=chain)
    assert out == ""
    assert err.splitlines() == [
        "chain.h5 holds the chain so far; the same command continues from there",
        "interrupted; no file is incomplete",
    ]
    with import_module("h5py").File(chain, "r") as file:
        assert len(file["points"]) >= 50
    assert sorted(p.name for p in tmp_path.iterdir()) == ["chain.h5", "levels.csv"]


@POSIX
@pytest.mark.parametrize("arguments", [
    ("report", "-", "--bootstrap", "--posterior", "-o", "new.html"),
    ("extract", "-", "--controlled", "force", "-o", "new.csv"),
])  # fmt: skip
def test_an_interrupt_leaves_nothing(tmp_path, arguments):
    out, err = interrupted(tmp_path, *arguments)
    assert (out, err) == ("", "interrupted; no file is incomplete\n")
    assert not list(tmp_path.iterdir())


@POSIX
def test_an_interrupt_leaves_the_old_file_whole(tmp_path):
    target = tmp_path / "long.csv"
    target.write_text("as it was", encoding="utf-8")
    interrupted(
        tmp_path, "simulate", "--f-max", "0.1", "--sigma", "30", "--mass", "0.3", "--damping",
        "0.2", "--stiffness", "0.3", "--record", "--controlled", "force", "--levels",
        "1e-3:1e-1:400", "--settling-periods", "400", "-o", "long.csv", "--overwrite",
    )  # fmt: skip
    assert target.read_text(encoding="utf-8") == "as it was"
    assert [p.name for p in tmp_path.iterdir()] == ["long.csv"]


@POSIX
@pytest.mark.parametrize("command", ["datasets", "--help", "simulate run.toml -o -"])
def test_a_reader_that_has_seen_enough_is_no_error(tmp_path, command):
    levels = ", ".join(str(1e-5 * (i + 1)) for i in range(800))  # more than a pipe holds
    (tmp_path / "run.toml").write_text(
        "[[plant]]\nkind = 'dahl'\nf_max = 0.1\nsigma = 30.0\n[excitation]\n"
        f"kind = 'stepped_sine'\nlevels = [{levels}]\nfrequencies_hz = [1.0]\n"
        "controlled = 'displacement'\n[table]\n",
        encoding="utf-8",
    )
    ours, theirs = os.pipe()
    os.close(ours)
    ended = subprocess.run(
        [str(PROGRAM), *command.split()], stdout=theirs, stderr=subprocess.PIPE, cwd=tmp_path
    )
    os.close(theirs)
    assert (ended.returncode, ended.stderr) == (1, b"")


@POSIX
@pytest.mark.parametrize(
    ("command", "status", "says"),
    [
        ("datasets >&-", 1, b"error: standard output is closed; send it to a file, or /dev/null\n"),
        ("datasets noisy -o n.csv >&- 2>&-", 1, b""),
        ("fit - <&-", 1, b"error: standard input: the file is empty\n"),
        ("datasets noisy -o n.csv 2>&-", 0, b""),
    ],
)
def test_closed_streams(tmp_path, command, status, says):
    words = ["sh", "-c", f"exec {PROGRAM} {command}"]
    ended = subprocess.run(words, stderr=subprocess.PIPE, cwd=tmp_path)
    assert (ended.returncode, ended.stderr) == (status, says)
    assert list(tmp_path.iterdir()) == ([] if status else [tmp_path / "n.csv"])


def test_of_two_writers_one_fails(tmp_path, monkeypatch):
    place, other = tmp_path / "t.csv", b"of somebody else"
    written = Path.write_bytes

    def slow(path, content):
        """Write; meanwhile another writer finishes."""
        written(place, other)
        return written(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", slow)
        with pytest.raises(DataError, match="exists already"):
            friction_table().save(place)
    assert place.read_bytes() == other
    assert list(tmp_path.iterdir()) == [place]
    program = (
        "import sys; from tests.bayes_cases import friction_table; sys.stdin.read(1);"
        "friction_table().save(sys.argv[1])"
    )
    place.unlink()
    words, pipe = [sys.executable, "-c", program, place], subprocess.PIPE
    several = [subprocess.Popen(words, stdin=pipe, stderr=pipe) for _ in range(3)]
    ended = [one.communicate(b"x") for one in several]
    assert sorted(one.returncode for one in several) == [0, 1, 1]
    assert sum(b"exists already" in err for _, err in ended) == 2


@pytest.mark.parametrize(
    "command", ["--help", "inspect größe.csv", "report größe.csv -o -", "nosuchß"]
)
def test_an_old_encoding_breaks_nothing(tmp_path, command):
    friction_table().save(tmp_path / "größe.csv")
    done = subprocess.run(
        [str(PROGRAM), *command.split()], capture_output=True, cwd=tmp_path,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )  # fmt: skip
    assert done.returncode == (2 if command == "nosuchß" else 0), done.stderr
    assert b"Traceback" not in done.stderr
    if command.startswith("report"):  # a file on standard output is as it is on the disk
        assert "±" in done.stdout.decode("utf-8")
    else:
        assert (done.stdout + done.stderr).isascii()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
def test_a_name_that_is_no_text_is_told_and_reported(run):
    name = os.fsdecode(b"l\xff.csv")
    Path(name).write_bytes(b"")
    assert run.refused("fit", name) == "error: l\\udcff.csv: the file is empty\n"
    Path(name).unlink()
    friction_table().save(name)
    assert run("fit", name, "--report", "r.html").status == 0
    assert "l\\udcff.csv" in Path("r.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", [
    "fit levels.csv --report {}", "fit levels.csv --save {}", "report levels.csv -o {}",
    "sample levels.csv --report {}", "datasets noisy -o {}",
    "simulate --f-max 1 --sigma 2 -o {}",
])  # fmt: skip
def test_a_place_that_cannot_be_is_refused_before_any_work(run, command):
    Path("file.json").write_text("mine", encoding="utf-8")
    Path("folder.json").mkdir()
    Path("levels.csv").write_text("no table, so that any work would end with another error")
    for place, says in {
        "absent/new.json": "absent/new.json: there is no folder absent; make it, or give",
        "file.json/new.json": "file.json/new.json: there is no folder file.json; make it",
        "folder.json": "folder.json is a folder; give the path of a file in it",
    }.items():
        words = command.format(place).split()
        for overwrite in ([], ["--overwrite"]):
            assert run.refused(*words, *overwrite).startswith(f"error: {says}")
    assert sorted(p.name for p in Path().iterdir()) == ["file.json", "folder.json", "levels.csv"]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")
@pytest.mark.parametrize("command", [
    "fit levels.csv --save /proc/new.json", "report levels.csv -o /proc/new.html",
    "sample levels.csv --resume /proc/new.h5", "datasets noisy -o /proc/new.csv",
    "demo -o /proc/new",
])  # fmt: skip
def test_a_folder_that_takes_no_files_is_one_line(run, command):
    friction_table().save("levels.csv")
    error = run.refused(*command.split())
    assert error.startswith(f"error: {command.split()[-1]}")
    assert "cannot be" in error


def test_a_chain_on_a_full_disk_is_one_line_and_leaves_the_old_file(run, monkeypatch):
    friction_table().save("levels.csv")
    options = ("sample", "levels.csv", "--resume", "chain.h5", "--steps")
    run(*options, "60")
    before = Path("chain.h5").read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert run.refused(*options, "120") == (
        "error: chain.h5: the chain cannot be written: No space left on device; the previous "
        "content of the file is unchanged\n"
    )
    assert Path("chain.h5").read_bytes() == before
    assert sorted(p.name for p in Path().iterdir()) == ["chain.h5", "levels.csv"]
    with pytest.raises(SamplingError, match="No space left"):
        di.posterior(friction_table(), di.Dahl(), seed=1, steps=60, resume="new.h5")


TABLE = (
    "frequency_hz,amplitude [mm],{drive}gain [N/m],phase_deg\n1,1,{value}30,10\n1,2,{value}25,20\n"
)
RECORD = "time [s],displacement [m],force [N]\n0,1,1\n1,2,2\n2,1,1\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fit", "t.csv", "--drive-factor", "2 N/V"),
         "t.csv: drive_factor is given, but no column holds the drive; expected a drive in V or A"),
        (("fit", "newton.csv", "--drive-factor", "2 N/V"),
         "newton.csv: drive_factor is given, but the drive (drive) is a force already"),
        (("fit", "t.csv", "--drive", "2 N", "--drive-factor", "2 N/V"),
         "t.csv: drive_factor is given, but the drive (2 N) is a force already"),
        (("extract", "r.csv", "--drive-factor", "2 N/V"),
         "r.csv: drive_factor is given, but no column holds the drive"),
        (("extract", "r.csv", "--drive-factor-uncertainty", "0.1"),
         "r.csv: drive_factor_uncertainty is given, but no column holds the drive"),
        (("extract", "volt.csv", "--drive-factor-uncertainty", "0.1"),
         "volt.csv: drive_factor_uncertainty is given without drive_factor; give both"),
        (("extract", "r.csv", "--time", "time", "--sample-rate", "5"),
         "time and sample_rate are both given"),
        (("fit", "levels.csv", "--level", "high"),
         "levels.csv: --level high is given, but the table has its own levels"),
        (("fit", "t.csv", "--level", "high", "--level-from-name", "(t)"),
         "level and level_from_name are both given"),
        (("simulate", "run.toml", "--f-max", "3", "--force-std", "0.1"),
         "--f-max, --force-std is given together with run.toml, which describes the whole"),
        (("report", "t.csv", "--waveforms-columns", "columns.toml"),
         "--waveforms-columns is given without --waveforms"),
    ],
)  # fmt: skip
def test_input_without_effect_or_of_another_kind_is_refused(run, arguments, message):
    Path("t.csv").write_text(TABLE.format(drive="", value=""), encoding="utf-8")
    Path("newton.csv").write_text(TABLE.format(drive="drive [N],", value="1,"), encoding="utf-8")
    labelled = TABLE.format(drive="level,", value="low,")
    Path("levels.csv").write_text(labelled, encoding="utf-8")
    Path("r.csv").write_text(RECORD, encoding="utf-8")
    Path("volt.csv").write_text(RECORD.replace("force [N]", "drive [V]"), encoding="utf-8")
    assert run.refused(*arguments).startswith(f"error: {message}")


def test_a_chain_keeps_the_seed_it_was_begun_with(run):
    friction_table().save("levels.csv")
    options = ("sample", "levels.csv", "--alpha", "1", "--resume", "chain.h5")
    assert run(*options, "--steps", "60", "--seed", "5").status == 3
    assert run(*options, "--steps", "70").err.startswith("not to be trusted: ")
    assert "begun with seed 5, but seed is 6" in run(*options, "--seed", "6").err


@pytest.mark.parametrize("columns", [40, 80])
def test_no_number_is_broken_on_a_narrow_terminal(columns):
    pty = pytest.importorskip("pty", reason="terminals are POSIX")
    code = (
        "from dahl_ident.cli.console import table\n"
        "head = ['f [Hz]', 'A [m]', 'gain', 'phase [deg]', 'periods', 'verdict']\n"
        "row = ['2.5', '0.0008863', '56.96', '142.34', '31', 'not settled, by 3 %']\n"
        "table('points', head, [row])"
    )
    ours, theirs = pty.openpty()
    environment = {**os.environ, "COLUMNS": str(columns), "TERM": "xterm", "NO_COLOR": "1"}
    subprocess.run([sys.executable, "-c", code], stdout=theirs, env=environment, check=True)
    told = os.read(ours, 65536).decode()
    os.close(ours)
    os.close(theirs)
    lines = [line.split() for line in told.splitlines()]
    assert any(line[:5] == ["2.5", "0.0008863", "56.96", "142.34", "31"] for line in lines)
