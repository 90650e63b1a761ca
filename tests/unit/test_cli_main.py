"""The frame of the command line: verbs, exit statuses, one sentence for the user's errors."""

import json
import os
import subprocess
import sys

import pytest
import typer
import yaml
from typer.testing import CliRunner

import sl3d_slam
from sl3d_slam.cli.errors import Verbs
from sl3d_slam.cli.main import app
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError


def sl3d(*arguments, **options):
    command = [sys.executable, "-c", "from sl3d_slam.cli.main import main; main()", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def verbs_that_fail():
    """A command line framed like sl3d's whose verbs fail in every way there is."""
    failing = typer.Typer(cls=Verbs, pretty_exceptions_enable=False)

    @failing.command()
    def sentence():
        raise InputError("scan.bin: 1001 bytes is not a whole number of points")

    @failing.command()
    def interrupt():
        raise KeyboardInterrupt

    @failing.command()
    def bug():
        raise ZeroDivisionError("a bug")

    @failing.command("no")
    def answer_is_no():
        raise typer.Exit(1)

    return failing


def test_help_lists_the_verbs_and_the_exit_statuses():
    result = CliRunner().invoke(app, ["--help"])
    assert result.exit_code == 0
    assert "config" in result.output
    assert "Exit status" in result.output


@pytest.mark.parametrize("verb", [command.callback.__name__ for command in app.registered_commands])
def test_every_verb_explains_itself(verb):
    name = next(c.name or verb for c in app.registered_commands if c.callback.__name__ == verb)
    result = CliRunner().invoke(app, [name, "--help"])
    assert result.exit_code == 0, result.output


def test_version_is_printed():
    result = CliRunner().invoke(app, ["--version"])
    assert (result.exit_code, result.output.strip()) == (0, f"sl3d {sl3d_slam.__version__}")


@pytest.mark.parametrize("arguments", [["bogus"], ["config", "--bogus"], ["config", "extra"]])
def test_wrong_usage_is_status_2(arguments):
    assert CliRunner().invoke(app, arguments).exit_code == 2


def test_users_error_is_one_sentence_on_stderr_and_status_2():
    result = CliRunner().invoke(verbs_that_fail(), ["sentence"])
    assert result.exit_code == 2
    assert result.stderr == "sl3d: scan.bin: 1001 bytes is not a whole number of points\n"
    assert result.stdout == ""


def test_interrupt_is_status_130_with_a_word():
    result = CliRunner().invoke(verbs_that_fail(), ["interrupt"])
    assert result.exit_code == 130
    assert "sl3d: interrupted" in result.stderr


def test_answer_no_is_status_1():
    assert CliRunner().invoke(verbs_that_fail(), ["no"]).exit_code == 1


def test_bug_keeps_its_traceback():
    result = CliRunner().invoke(verbs_that_fail(), ["bug"])
    assert isinstance(result.exception, ZeroDivisionError)


def test_config_prints_what_a_run_would_use(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("keyframes:\n  min_distance_m: 7.5\n")
    result = CliRunner().invoke(app, ["config", "--config", str(path), "--set", "seed=3"])
    expected = SlamConfig().model_dump()
    expected["seed"], expected["keyframes"]["min_distance_m"] = 3, 7.5
    assert result.exit_code == 0
    assert yaml.safe_load(result.stdout) == expected


def test_config_names_a_wrong_key(tmp_path):
    result = sl3d("config", "--set", "input.max_rnge_m=3", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr == (
        "sl3d: --set: input.max_rnge_m is not a setting; did you mean input.max_range_m?\n"
    )


@pytest.mark.parametrize("verb", ["config", "buffered"])
def test_reader_that_stops_reading_is_no_error(verb):
    code = (
        "from sl3d_slam.cli.main import app, main\n"
        "@app.command()\n"
        "def buffered(): print('stays in the buffer until the end')\n"
        "main()"
    )
    read_end, write_end = os.pipe()
    os.close(read_end)
    with os.fdopen(write_end, "w") as closed:
        result = subprocess.run(
            [sys.executable, "-c", code, verb],
            stdout=closed,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert result.stderr == ""


def test_info_describes_a_folder_of_scans(tmp_path, rng):
    for name in ("a.bin", "b.bin"):
        rng.uniform(5.0, 40.0, (600, 4)).astype("<f4").tofile(tmp_path / name)
    result = CliRunner().invoke(app, ["info", str(tmp_path), "--json"])
    facts = json.loads(result.stdout)
    assert (facts["scans"], facts["points_in_the_first_scan"]) == (2, 600)
    assert facts["true_poses"] is False
    assert "scans: 2" in CliRunner().invoke(app, ["info", str(tmp_path)]).stdout


def test_info_shows_the_figures_of_a_run_again(tmp_path):
    figures = {"num_scans": 40, "ate_rmse_m": 0.125, "stages": {}}
    (tmp_path / "metrics.json").write_text(json.dumps(figures))
    assert "0.12 m" in CliRunner().invoke(app, ["info", str(tmp_path)]).stdout
    shown = CliRunner().invoke(app, ["info", str(tmp_path), "--json"]).stdout
    assert json.loads(shown) == figures


@pytest.mark.parametrize(
    "content", ["", "[1]", '{"num_scans": "many"}', '{"stages": 3}', "[" * 9999]
)
def test_info_names_damaged_figures(tmp_path, content):
    (tmp_path / "metrics.json").write_text(content)
    result = CliRunner().invoke(app, ["info", str(tmp_path)])
    assert result.exit_code == 2
    assert result.stderr.startswith(f"sl3d: {tmp_path}/metrics.json: expected the figures")
