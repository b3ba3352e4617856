"""Text tables: dialects, headers, units, and every way in which they can be wrong."""

import bz2
import gzip
import hashlib
import lzma

import numpy as np
import pytest

from dahl_ident.data import inspect, read_frequency_response, read_record
from dahl_ident.errors import DataError, DataWarning, UnitError

TIME, X, F = [0.0, 0.5, 1.0], [1e-3, 2.5e-3, -3e-3], [1000.0, 2000.0, 3500.0]


def written(tmp_path, text, name="run.csv"):
    path = tmp_path / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def assert_the_run(record):
    np.testing.assert_allclose(record.time, TIME, rtol=1e-15)
    np.testing.assert_allclose(record.displacement, X, rtol=1e-15)
    np.testing.assert_allclose(record.force, F, rtol=1e-15)


PLAIN = "time [s],x [mm],F [kN]\n0,1,1\n0.5,2.5,2\n1,-3,3.5\n"


class TestDialects:
    @pytest.mark.parametrize(
        "text",
        [
            PLAIN,
            PLAIN.rstrip(),
            PLAIN.replace("\n", "\r\n"),
            PLAIN.replace("\n", "\r"),
            PLAIN.replace(",", ";"),
            PLAIN.replace(",", "\t"),
            PLAIN.replace(",", "|"),
            PLAIN.replace(",", ", "),
            PLAIN.replace(",", ";").replace(".", ","),
            PLAIN.replace(",", "\t").replace(".", ","),
            PLAIN.replace(" [", "[").replace(",", "   "),
            PLAIN.replace(",", "   "),
            PLAIN.replace("[", "(").replace("]", ")").replace(",", "   "),
            "time   x    F\n[s]    [mm]    [kN]\n0 1 1\n0.5 2.5 2\n1 -3 3.5\n",
            PLAIN.replace(" [", "[").replace(",", " ").replace(".", ",").replace("\n", "\n  "),
            PLAIN.replace("[", "(").replace("]", ")"),
            "time,x,F\ns,mm,kN\n0,1,1\n0.5,2.5,2\n1,-3,3.5\n",
            "time,x,F\n[s],[mm],[kN]\n0,1,1\n0.5,2.5,2\n1,-3,3.5\n",
            '"time, s","x, mm","F, kN"\n0,1,1\n0.5,2.5,2\n1,-3,3.5\n',
            "Test rig 5\nSample rate,2\nOperator;A. Hill\n\n" + PLAIN,
            "Channel 1,Channel 2,Channel 3\n" + PLAIN,
            PLAIN.replace("\n0,", "\nRate=2 Hz,24 Bit,\n0,"),
            PLAIN.replace(" [", " / ").replace("]", ""),
            PLAIN.replace(" [", " in ").replace("]", ""),
            "# made by a logger\n# 3 channels\n" + PLAIN,
            "% made by a logger\n" + PLAIN + "% the end\n",
            "# " + PLAIN,
            PLAIN.replace("0.5", "# a pause\n\n0.5"),
            "time [s],x [mm],F [kN],\n0,1,1,\n0.5,2.5,2,\n1,-3,3.5,\n",
            "time [s],x [mm],F [kN]\n0,1,1,\n0.5,2.5,2,\n1,-3,3.5,\n",
            "time [s]\tx [mm]\tF [kN]\t\n0\t1\t1\t\n0.5\t2.5\t2\t\n1\t-3\t3.5\t\n",
            "time [s],,x [mm],F [kN]\n0,,1,1\n0.5,,2.5,2\n1,,-3,3.5\n",
            '"time [s]","x [mm]","F [kN]"\n"0","1","1"\n"0.5","2.5","2"\n"1","-3","3.5"\n',
            'time [s],"note, long","x [mm]",F [kN]\n0,a,1,1\n0.5,"b, c",2.5,2\n1,,-3,3.5\n',
            "time [s],x [mm],F [kN]\n0,1.0e0,1\n.5,+2.5E+0,2.\n1,-3,35e-1\n",
        ],
    )
    def test_every_dialect_reads_alike(self, tmp_path, text):
        assert_the_run(read_record(written(tmp_path, text)))

    def test_channels_called_by_numbers(self, tmp_path):
        path = written(tmp_path, "x-axis,1,2\nsecond,Volt,Volt\n0,1,1\n0.5,2.5,2\n1,-3,3.5\n")
        assert_the_run(read_record(path, time="x-axis", displacement="1 [mm]", force="2 [kN]"))

    @pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
    def test_encodings(self, tmp_path, encoding):
        text = PLAIN.replace("mm", "µm").replace("1,-3", "1,-3")
        record = read_record(written(tmp_path, text.encode(encoding)))
        np.testing.assert_allclose(record.displacement, np.array(X) * 1e-3)

    @pytest.mark.parametrize(
        ("ending", "pack"), [(".gz", gzip.compress), (".bz2", bz2.compress), (".xz", lzma.compress)]
    )
    def test_packed(self, tmp_path, ending, pack):
        assert_the_run(read_record(written(tmp_path, pack(PLAIN.encode()), f"run.csv{ending}")))

    def test_standard_input(self, tmp_path, monkeypatch):
        with written(tmp_path, PLAIN).open() as stream:
            monkeypatch.setattr("sys.stdin", stream)
            assert_the_run(read_record("-"))

    def test_numbers_are_read_to_the_last_digit(self, tmp_path):
        rng = np.random.default_rng(11)
        numbers = np.exp(rng.uniform(-200, 200, (2000, 2))) * rng.choice([-1.0, 1.0], (2000, 2))
        lines = [f"{i},{x!r},{f!r}" for i, (x, f) in enumerate(numbers.tolist())]
        text = "time [s],x [m],F [N]\n" + "\n".join(lines)
        record = read_record(written(tmp_path, text))
        np.testing.assert_array_equal(record.displacement, numbers[:, 0])
        np.testing.assert_array_equal(record.force, numbers[:, 1])

    def test_a_late_word_in_a_long_table(self, tmp_path):
        """Parsers that read in parts guess the types of each part."""
        lines = [f"{i},{i % 7},{i % 5}" for i in range(150_000)]
        lines[140_000] = "140000,oops,1"
        text = "time [s],x [mm],F [N]\n" + "\n".join(lines)
        with pytest.raises(DataError, match="line 140002, column 'x': 'oops' is not a number"):
            read_record(written(tmp_path, text))


class TestColumns:
    def test_names_units_signs_and_factors(self, tmp_path):
        path = written(tmp_path, "t,LVDT 2,cell,amp\n0,1,1,1\n0.5,2.5,2,2\n1,-3,3.5,3\n")
        columns = tmp_path / "lab.toml"
        columns.write_text(
            'drive_factor = "12.5 N/V"\ndrive_factor_uncertainty = 0.01\n'
            '[time]\ncolumn = "t"\nunit = "s"\n'
            '[displacement]\ncolumn = "LVDT 2"\nunit = "mm"\nsign = -1\n'
            '[force]\ncolumn = "cell"\nunit = "kN"\nfactor = 2.0\n'
            '[drive]\ncolumn = "amp"\nunit = "mV"\n'
        )
        record = read_record(path, columns=columns)
        np.testing.assert_allclose(record.displacement, -np.array(X))
        np.testing.assert_allclose(record.force, 2.0 * np.array(F))
        np.testing.assert_allclose(record.drive, [1e-3, 2e-3, 3e-3])
        assert (record.drive_unit, record.drive_factor) == ("V", 12.5)
        assert record.drive_factor_uncertainty == 0.01

    def test_keywords_name_columns_with_their_units(self, tmp_path):
        path = written(tmp_path, "a,b,c\n0,1,1\n0.5,2.5,2\n1,-3,3.5\n")
        assert_the_run(read_record(path, time="a [s]", displacement="b [mm]", force="c [kN]"))

    def test_keywords_override_the_map(self, tmp_path):
        path = written(tmp_path, "t [s],x [mm],y [mm],F [kN]\n0,9,1,1\n0.5,9,2.5,2\n1,9,-3,3.5\n")
        assert_the_run(read_record(path, columns={"displacement": "x"}, displacement="y"))

    def test_headerless_table_with_a_map(self, tmp_path):
        path = written(tmp_path, "0,1,1\n0.5,2.5,2\n1,-3,3.5\n")
        columns = {"time": "column 1 [s]", "displacement": "column 2 [mm]"}
        assert_the_run(read_record(path, columns=columns, force="column 3 [kN]"))

    def test_sample_rate_instead_of_time(self, tmp_path):
        record = read_record(
            written(tmp_path, "x [mm],F [kN]\n1,1\n2.5,2\n-3,3.5\n"), sample_rate=2.0
        )
        assert_the_run(record)
        assert record.provenance["notes"] == ["time counted from the sample rate of 2 Hz"]

    def test_provenance(self, tmp_path):
        path = written(tmp_path, PLAIN)
        provenance = read_record(path).provenance
        assert provenance == {
            "file": str(path),
            "format": "text table",
            "sha256": hashlib.sha256(PLAIN.encode()).hexdigest(),
        }
        provenance = read_record(path, displacement="x", columns={"force": "F"}).provenance
        assert provenance["options"] == {"columns": {"force": "F"}, "displacement": "x"}

    def test_rotation(self, tmp_path):
        record = read_record(
            written(tmp_path, "t [s],position [deg],torque [lbf-in]\n0,90,1\n1,180,2\n")
        )
        assert record.motion == "rotation"
        np.testing.assert_allclose(record.displacement, [np.pi / 2, np.pi])

    @pytest.mark.parametrize(
        ("header", "channel", "factor"),
        [("vel [mm/s]", "velocity", 1e-3), ("acc [g]", "acceleration", 9.80665)],
    )
    def test_other_motions(self, tmp_path, header, channel, factor):
        record = read_record(written(tmp_path, f"t [s],{header},F [N]\n0,1,1\n1,2,2\n"))
        np.testing.assert_allclose(getattr(record, channel), [factor, 2 * factor])

    def test_missing_samples_become_gaps_on_request(self, tmp_path):
        text = "t [s],x [mm],F [N]\n0,1,1\n1,,2\n2,3,3\n3,4,nan\n4,5,5\n5,6,6\n"
        with pytest.raises(
            DataError, match=r"line 3, column 'x': the cell is empty or NaN \(1 such"
        ):
            read_record(written(tmp_path, text))
        record = read_record(written(tmp_path, text), missing="drop")
        assert record.time.tolist() == [0.0, 2.0, 4.0, 5.0]
        assert "2 samples with missing values left out" in record.provenance["notes"]

    def test_missing_samples_keep_their_place_in_counted_time(self, tmp_path):
        path = written(tmp_path, "x [mm],F [N]\n1,1\n,2\n3,3\n4,4\n")
        record = read_record(path, sample_rate=10.0, missing="drop")
        np.testing.assert_allclose(record.time, [0.0, 0.2, 0.3])


class TestUnusualTables:
    def test_rows_that_end_in_two_delimiters(self, tmp_path):
        text = PLAIN.replace("\n0", ",,\n0").replace(",1\n", ",1,,\n").replace("2\n", "2,,\n")
        assert_the_run(read_record(written(tmp_path, text.replace("3.5\n", "3.5,,\n"))))

    def test_colons_between_fields(self, tmp_path):
        assert_the_run(read_record(written(tmp_path, PLAIN.replace(",", ":"), "run.txt")))

    def test_thousands_of_columns(self, tmp_path):
        rng = np.random.default_rng(1)
        noise = rng.normal(size=(30, 2000))
        lines = ["time [s],x [mm],F [kN]," + ",".join(f"c{i}" for i in range(2000))]
        for t, row in enumerate(noise):
            lines.append(f"{t},{t % 7},{t % 5}," + ",".join(map(repr, row.tolist())))
        record = read_record(written(tmp_path, "\n".join(lines) + "\n"))
        assert record.n == 30
        np.testing.assert_allclose(record.force_samples, 1e3 * (np.arange(30) % 5))

    @pytest.mark.parametrize(
        ("text", "force"),
        [
            ('time [s],x [mm],F [N]\n0,1,"1,234.5"\n1,2,"2,345"\n', [1234.5, 2345.0]),
            ("time [s];x [mm];F [N]\n0;1;1.234,5\n1;2;2.345\n", [1234.5, 2345.0]),
            ("time [s]\tx [mm]\tF [N]\n0\t1\t1,234,567\n1\t2\t12\n", [1234567.0, 12.0]),
            ("time [s];x [mm];F [N]\n0;1;1,234\n1;2;2,345\n", [1.234, 2.345]),  # as ever
        ],
    )
    def test_marks_of_thousands(self, tmp_path, text, force):
        found = read_record(written(tmp_path, text)).force_samples
        np.testing.assert_allclose(found, force)

    def test_marks_of_thousands_at_the_wrong_place(self, tmp_path):
        text = "time [s];x [mm];F [N]\n0;1;1,234.5\n1;2;23,45\n"
        with pytest.raises(DataError, match=r"column 'F': .* is not a number"):
            read_record(written(tmp_path, text))

    @pytest.mark.parametrize("third", ["0,02,1,45,0,38", "0,02,1,4,0", "0,02,1,0"])
    def test_decimal_commas_between_commas_are_named(self, tmp_path, third):
        text = f"time [s],x [mm],F [N]\n0,00,1,25,0,31\n0,01,1,35,0,36\n{third}\n0,03,1,5,0,39\n"
        with pytest.raises(DataError, match=r"3 columns are named .* commas seem to be decimal"):
            read_record(written(tmp_path, text))

    def test_decimal_commas_in_quotes(self, tmp_path):
        rows = "".join(f'"0,0{i}","1,{i}5","0,{i}"\n' for i in range(4))
        record = read_record(written(tmp_path, f"time [s],x [mm],F [N]\n{rows}"))
        np.testing.assert_allclose(record.displacement, [1.05e-3, 1.15e-3, 1.25e-3, 1.35e-3])
        np.testing.assert_allclose(record.force, [0.0, 0.1, 0.2, 0.3])

    def test_what_inspect_prints_is_a_column_map(self, tmp_path):
        path = written(tmp_path, "Zeit (s);Weg (mm);Kraft (N)\n0,0;1,5;2\n0,1;1,7;3\n0,2;2;4\n")
        with pytest.raises(DataError, match="inspect proposes a column map"):
            read_record(path)
        proposal = written(tmp_path, repr(inspect(path)), "columns.toml")
        assert read_record(path, columns=proposal).force.tolist() == [2.0, 3.0, 4.0]

    @pytest.mark.parametrize(
        "stamp", ["2024-03-31T12:00:{:06.3f}", "2024-03-31 12:00:{:06.3f}Z", "12:00:{:06.3f}",
                  "2024-03-31T12:00:{:06.3f}+0200"]
    )  # fmt: skip
    def test_time_stamps(self, tmp_path, stamp):
        rows = [f"{stamp.format(t)},{i},{i}" for i, t in enumerate((58.5, 59.0, 59.75))]
        record = read_record(written(tmp_path, "\n".join(["time,x [mm],F [N]", *rows])))
        np.testing.assert_allclose(record.time, [0.0, 0.5, 1.25], atol=1e-9)
        assert "time counted from the stamp" in repr(record)
        proposal = written(tmp_path, inspect(tmp_path / "run.csv").column_map, "columns.toml")
        assert read_record(tmp_path / "run.csv", columns=proposal).n == 3

    def test_invalid_time_stamps_and_zones(self, tmp_path):
        text = "time,x [mm],F [N]\n12:00:01,1,1\n12:00:61,1,1\n"
        with pytest.raises(
            DataError, match="line 3, column 'time': '12:00:61' is not a time stamp"
        ):
            read_record(written(tmp_path, text))
        zones = (
            "timestamp,x [mm],F [N]\n2024-03-31T01:59:59+01:00,1,1\n2024-03-31T03:00:00+02:00,2,2\n"
        )
        assert read_record(written(tmp_path, zones)).time.tolist() == [0.0, 1.0]

    @pytest.mark.parametrize(
        "footer",
        [
            "End of data\n",
            ",,\n,,\n",
            "\nMean,0.1,0.2\nMax,1,2\n",
            "*** end ***",
            "Checked by: A. Hill",
        ],
    )
    def test_lines_below_the_table(self, tmp_path, footer):
        record = read_record(written(tmp_path, PLAIN + footer))
        assert_the_run(record)
        assert "left out below the table" in repr(record)

    def test_a_repeated_header_begins_a_run(self, tmp_path):
        day = "frequency_hz,amplitude [m],real [N/m],imag [N/m]\n1,1,2,1\n1,2,2,1\n"
        table = written(tmp_path, day + day + day.replace("1,2,2,1\n", ""))
        with pytest.warns(DataWarning, match="the header is repeated in the file: read as 3 runs"):
            data = read_frequency_response(table)
        assert data.amplitude.tolist() == [1, 2, 1, 2, 1]
        assert data.run.tolist() == ["1", "1", "2", "2", "3"]
        units = "frequency,amplitude,real,imag\nHz,m,N/m,N/m\n1,1,2,1\n1,2,2,1\n"
        with pytest.warns(DataWarning, match="read as 2 runs"):
            assert read_frequency_response(written(tmp_path, units + units)).runs == ["1", "2"]

    def test_a_converter_that_sticks(self, tmp_path):
        t = np.arange(400) / 100.0
        x, force = np.sin(2 * np.pi * t), np.cos(2 * np.pi * t)

        def text(values):
            rows = (f"{a!r},{b!r},{c!r}" for a, b, c in np.column_stack([t, x, values]).tolist())
            return "time [s],x [mm],F [N]\n" + "\n".join(rows) + "\n"

        for good in (force, np.sign(force), np.clip(3.0 * force, -1.0, 1.0), np.round(force, 1)):
            assert read_record(written(tmp_path, text(good))).n == 400
        force[115:135] = force[115]
        with pytest.warns(DataWarning, match=r"goes on, from line 117 \(1 such places\)"):
            record = read_record(written(tmp_path, text(force)))
        assert "the force repeats one value" in repr(record)
        noisy = np.cos(2 * np.pi * t) + 0.05 * np.random.default_rng(0).standard_normal(t.size)
        for place in (110, 250, 390):
            noisy[place : place + 10] = noisy[place]
        with pytest.warns(DataWarning, match=r"goes on, from line 112 \(3 such places\)"):
            read_record(written(tmp_path, text(noisy)))

    def test_a_line_of_brackets_ends(self, tmp_path):
        for text in ("[" * 200_000, "(" * 200_000, "x" + " " * 200_000 + "["):
            for table in (f"{text}\n0 1\n1 2\n", f"{text},b\n0,1\n1,2\n"):
                with pytest.raises(DataError):
                    read_record(written(tmp_path, table))

    def test_damaged_comments_of_this_package(self, tmp_path):
        for comment in ("{oops", "[" * 100_000, '{"quality": 3}', '{"text": [1]}',
                        '{"drive_factor": "x"}',
                        '{"unknown": 1}', '{"provenance": {"warnings": 5}}',
                        '{"provenance": {"parts": [{"notes": [1]}]}}'):  # fmt: skip
            with pytest.raises(DataError, match="line 1: the comment after 'dahl_ident:'"):
                read_record(written(tmp_path, f"# dahl_ident: {comment}\n{PLAIN}"))


class TestRefusal:
    """Bad input never gives numbers; the message says where it is and what to do."""

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "the file is empty"),
            (" \n\n", "the file is empty"),
            ("# c\n" * 21_000 + PLAIN, "the first 20000 lines are comments or blank"),
            ("\n" * 21_000 + PLAIN, "the first 20000 lines are comments or blank"),
            ("just some words\nand more words\n", "no table of numbers found"),
            ("1\n2\n3\n", "no table of numbers found"),
            ("0,1,1\n0.5,2.5,2\n", "no header line; expected names and units above the numbers"),
            ("a,b\n1,2,3\n", "the header names 2 columns, the rows have 3; expected a name"),
            ("a,b,c,d\n1,2,3\n", "no header line"),
            (PLAIN + "2,3\n", r"the last line has 2 fields, '2,3', where the others have 3"),
            (PLAIN + "2;3\n", "the last line has 1 fields, '2;3'"),
            (PLAIN + "#DIV/0!,2,3\n", "line 5: the line begins as a comment, yet its cells"),
            (PLAIN + "#DIV/0!,#DIV/0!,3\n2,3,4\n", "line 5: the line begins as a comment, yet"),
            (PLAIN + "#REF!,2\n2,3,4\n", "line 5: the line begins as a comment, yet"),
            ("# " + PLAIN + "# " + PLAIN, "line 6: the header is repeated above this line"),
            (
                "# " + PLAIN + "# " + PLAIN.replace("mm", "um"),
                r"line 5: '# time \[s\],x \[um\],F \[kN\]' names the columns again, with other",
            ),
            (
                "# time,x,F\n# s,mm,kN\n0,1,1\n1,2,2\n# time,x,F\n# s,um,kN\n0,1,1\n",
                "line 6: '# s,um,kN' names the columns again",
            ),
            (PLAIN.replace("\n0,1,1", "\n#DIV/0!,1,1"), "line 2: the line begins as a comment"),
            (PLAIN + PLAIN, "line 6: the header is repeated above this line .2 records in one"),
            (PLAIN + "Sunday;too\nX,1,2\n", "line 5, column"),
            ("time [s],x [mm]\n" + "9" * 300_000, "more than 262144 bytes"),
            ("t," * 5002 + "\n" + "1," * 5002 + "\n", "has 500. fields; at most 5000"),
            (PLAIN + "2,3,4,5\n3,4,5\n", "line 5 has 4 fields; expected 3 as in the lines above"),
            (PLAIN.replace("2.5", "two"), r"run.csv, line 3, column 'x': 'two' is not a number"),
            (PLAIN.replace("2.5", "2,5"), "line 3 has 4 fields; expected 3"),
            (PLAIN.replace("2.5", "1_000"), r"line 3, column 'x': '1_000' is not a number"),
            (PLAIN.replace("2.5", ""), r"line 3, column 'x': the cell is empty or NaN"),
            (PLAIN.replace("2.5", "NaN"), r"line 3, column 'x': the cell is empty or NaN"),
            (PLAIN.replace("2.5", "inf"), r"line 3, column 'x': the cell is inf"),
            (PLAIN.replace("2.5", "1e300"), r"line 3, column 'x': the cell is 1e\+300"),
            (PLAIN.replace("2.5", "True"), r"line 3, column 'x': 'True' is not a number"),
            (PLAIN.replace("\n1,", "\n0.2,"), r"line 4, column 'time': time is 0.2 after 0.5 \(1 "),
            (PLAIN.replace("\n1,", "\n0.5,"), "time is 0.5 after 0.5"),
            (
                PLAIN.replace("F [kN]", "x [mm]"),
                r"2 columns may be the displacement: x \[mm\], x \[mm\]; rename them in the file",
            ),
            (PLAIN.replace("F [kN]", "disp [mm]"), "say which one with columns={'displacement'"),
            (PLAIN.replace("x [", "u ["), "no motion found; expected one of displacement"),
            (PLAIN.replace("F [", "load ["), r"no column holds the force; there are time \[s\], x"),
            (PLAIN.replace("time [s]", "clock [s]"), "no column holds the time"),
            (PLAIN.replace("mm", "um rms"), r"unit \[um rms\]; expected the samples of a waveform"),
            ("time [s],x [mm],F [kN]\n0,1,1\n", "time: expected at least two samples"),
        ],
    )
    def test_bad_tables(self, tmp_path, text, message):
        with pytest.raises((DataError, UnitError), match=message):
            read_record(written(tmp_path, text))

    @pytest.mark.parametrize("odd", ["1.024", "OVERLOAD"])
    def test_a_point_next_to_decimal_commas_is_refused(self, tmp_path, odd):
        text = PLAIN.replace(",", ";").replace(".", ",").replace("2,5", odd)
        with pytest.raises(DataError, match=f"line 3, column 'x': '{odd}' is not a number with a"):
            read_record(written(tmp_path, text))

    @pytest.mark.parametrize(("lost", "found"), [(1, 3), (3, 1), (5, 0)])
    def test_a_last_number_without_its_last_digits(self, tmp_path, lost, found):
        text = PLAIN + "".join(f"{i},{i}.5,12.0{i:03}\n" for i in range(2, 102))
        text = text.replace("\n0,1,1\n0.5,2.5,2\n1,-3,3.5", "")
        assert read_record(written(tmp_path, text.rstrip())).time.size == 100
        with pytest.raises(DataError, match=f"has {found} decimals and no line end, where all ab"):
            read_record(written(tmp_path, text[: -1 - lost]))

    def test_line_numbers_count_preamble_comments_and_blanks(self, tmp_path):
        text = "rig 5\n\n# c\n" + PLAIN.replace("0.5", "\n# pause\n0.5").replace("2.5", "two")
        with pytest.raises(DataError, match="line 8, column 'x'"):
            read_record(written(tmp_path, text))

    def test_units(self, tmp_path):
        with pytest.raises(UnitError, match=r"'x' has no unit; .*'x \[um\]'.*'unit': 'um'"):
            read_record(written(tmp_path, PLAIN.replace("x [mm]", "x")))
        with pytest.raises(UnitError, match=r"the force has the unit \[mm\]; expected"):
            read_record(written(tmp_path, PLAIN.replace("kN", "mm")))
        columns = {"displacement": {"unit": "mm"}, "force": {"column": "X"}}
        with pytest.raises(UnitError, match="the force has the unit"):
            read_record(written(tmp_path, PLAIN), columns=columns)
        with pytest.raises(UnitError, match=r"column 'F': \[wat\] is not a known unit"):
            read_record(written(tmp_path, PLAIN.replace("kN", "wat")))
        path = written(tmp_path, "t [s],x [deg],F [N],M [Nm]\n0,1,1,1\n1,2,2,2\n")
        with pytest.raises(UnitError, match=r"units disagree: .*translation, drive is rot"):
            read_record(path, drive="M", force="F")

    def test_binary_behind_a_text_extension(self, tmp_path):
        with pytest.raises(DataError, match=r"the file is binary \(byte 5 is 0\)"):
            read_record(written(tmp_path, b"hello\0world"))

    def test_damaged_packing(self, tmp_path):
        packed = gzip.compress(PLAIN.encode())[:-9]
        with pytest.raises(DataError, match="the compressed file is damaged"):
            read_record(written(tmp_path, packed, "run.csv.gz"))

    def test_absent_file(self, tmp_path):
        with pytest.raises(DataError, match="cannot be read: No such file"):
            read_record(tmp_path / "absent.csv")

    @pytest.mark.versions
    @pytest.mark.parametrize(
        ("columns", "message"),
        [
            ({"froce": "F"}, "columns: unknown entry 'froce'; expected one of time, displacement"),
            (
                {"force": {"col": "F"}},
                "columns: force: unknown entry 'col'; .*did you mean 'column'",
            ),
            ({"force": {"unit": 3}}, "force: unit is 3; expected text"),
            ({"force": {"column": "F", "sign": 2}}, "force: sign is 2; expected 1 or -1"),
            ({"force": {"column": "F", "sign": True}}, "force: sign is True; expected a whole"),
            ({"force": 3}, "force is 3; expected a column's name, or a table"),
            ({"force": {"column": len}}, "force: column is <built-in .*; expected text in quotes"),
            ({"force": {"column": "F", "factor": -2}}, "force: factor is -2.0"),
            ({"force": "load"}, r"no column is called 'load'; there are time, x, F"),
            ({"velocity": {"unit": "mm/s"}}, "no column is called velocity or vel or v"),
            ({"sample_rate": 0}, "sample_rate is 0.0"),
            ({"sample_rate": "100"}, "sample_rate is '100'; expected a number"),
            ({"drive_factor": 12.5}, "drive_factor is 12.5; expected text such as '12.5 N/V'"),
            ({"quantity": "stiffness"}, "quantity is 'stiffness'"),
            ({"controlled": 5}, "controlled is 5; expected 'displacement' or 'force'"),
        ],
    )
    def test_bad_column_maps(self, tmp_path, columns, message):
        with pytest.raises(DataError, match=message):
            read_record(written(tmp_path, PLAIN), columns=columns)

    def test_bad_column_map_files(self, tmp_path):
        path = written(tmp_path, PLAIN)
        with pytest.raises(DataError, match="the column map cannot be read: No such file"):
            read_record(path, columns=tmp_path / "absent.toml")
        broken = written(tmp_path, "time = = 3", "lab.toml")
        with pytest.raises(DataError, match="not a TOML file"):
            read_record(path, columns=broken)


def test_small_and_large_tables_are_read_alike(tmp_path):
    """Small ones are parsed without pandas, to the last digit and with the same kinds."""
    rng = np.random.default_rng(1)
    rows = [
        f"{f},{A!r},{g!r},{p:.3e},{c}\n"
        for f, A, g, p, c in zip(
            rng.integers(1, 9, 20), np.exp(rng.normal(-7, 3, 20)).tolist(),
            rng.lognormal(3, 1, 20).tolist(), rng.uniform(5, 80, 20),
            ["force", "displacement"] * 10, strict=True,
        )
    ]  # fmt: skip
    head = "frequency_hz,amplitude [m],gain [N/m],phase_deg,controlled\n"
    small, large = tmp_path / "small.csv", tmp_path / "large.csv"
    small.write_text(head + "".join(rows))
    large.write_text(head + "".join(rows * 60))
    assert small.stat().st_size < 1 << 16 < large.stat().st_size
    a, b = read_frequency_response(small), read_frequency_response(large)
    np.testing.assert_array_equal(a.response, b.response[:20])
    np.testing.assert_array_equal(a.amplitude, np.asarray(b.amplitude)[:20])
    np.testing.assert_array_equal(a.frequency_hz, b.frequency_hz[:20])
    np.testing.assert_array_equal(a.controlled, b.controlled[:20])


@pytest.mark.parametrize("above", ["", "# a pause\n", "\n"])
@pytest.mark.parametrize("below", ["", "End of data\n", "Mean,0.1,0.2\n", ",,\n", "# the end\n"])
def test_large_tables_with_words_among_them(tmp_path, above, below):
    rows = [f"12:00:{i // 100:02}.{i % 100:02},{i % 7}.5,{i % 5}\n" for i in range(5000)]
    text = "time,x [mm],F [N]\n" + "".join(rows[:4000]) + above + "".join(rows[4000:]) + below
    record = read_record(written(tmp_path, text))
    assert record.n == 5000
    np.testing.assert_allclose(record.time, np.arange(5000) / 100.0, atol=1e-9)
    np.testing.assert_allclose(record.displacement, (np.arange(5000) % 7 + 0.5) * 1e-3)
    with pytest.raises(DataError, match=rf"line {4502 + bool(above)}, column 'x': 'two' is not a"):
        read_record(
            written(tmp_path, text.replace(rows[4500], rows[4500].replace(",6.5,", ",two,")))
        )
