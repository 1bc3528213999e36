"""`rotorwatch plot`: pictures as files, the same bytes for the same input, and errors that name the cause."""

import struct
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from matplotlib import get_cachedir
from typer.testing import CliRunner

from models.signals.recording import RecordedMessage, read_recording
from service.commands.rotorwatch import app
from simulator.scenario import Event, parse_fault
from tests.service.rig import replaying
from tests.service.rig.live import LAB, START_NS, scenario_blocks
from tests.service.rig.preloaded import ran
from tests.service.rig.replaying import recording, write


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recording(tmp_path_factory.mktemp("plots") / "faulty.mcap", scenario_blocks(66.0, parse_fault("c_bz=0.5@0")))


@pytest.fixture(scope="module")
def run_up(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated machine from 900 to 2400 rpm, through its resonances."""
    ramp = (Event(at_s=0.5, speed_rpm=900.0), Event(at_s=2.0, speed_rpm=2400.0, ramp_s=26.0))
    return recording(tmp_path_factory.mktemp("plots") / "runup.mcap", scenario_blocks(30.0, *ramp))


@pytest.fixture(scope="module")
def without_angle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return replaying.without_angle(tmp_path_factory.mktemp("plots") / "plain.mcap", scenario_blocks(5.0))


def run(*arguments: str | Path) -> tuple[int, str]:
    found = CliRunner().invoke(app, ["plot", *map(str, arguments)])
    return found.exit_code, found.output


def pixels(path: Path) -> tuple[int, int]:
    head = path.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", head[16:24])
    return width, height


@pytest.mark.parametrize("kind", [pytest.param("trend", marks=pytest.mark.long), "correlation", "spectrum"])
def test_plots_of_a_steady_machine(faulty: Path, tmp_path: Path, kind: str) -> None:
    out = tmp_path / "picture.svg"
    code, said = run(kind, faulty, "--out", out, "--size", "8x6")
    assert (code, said.strip()) == (0, str(out)), said
    root = ET.parse(out).getroot()  # noqa: S314  # written a moment ago
    assert (root.attrib["width"], root.attrib["height"]) == ("576pt", "432pt")
    assert sum(1 for _ in root.iter("{http://www.w3.org/2000/svg}path")) > 20


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("bode", ("--channel", "y2", "--revolutions", "8", "--order", "2", "--slow-roll", "1000")),
        pytest.param("polar", ("--channel", "y1", "--channel", "z1"), marks=pytest.mark.long),
        ("centreline", ("--place", "disc", "--clearance", "200", "--window", "0.5")),
        ("full-spectrum", ("--axis", "orders", "--window", "5", "--scale", "log", "--to-hz", "100")),
        ("waveform", ("--channel", "y2_dot", "--window", "2.5")),
    ],
)
def test_plots_of_a_simulated_run_up(run_up: Path, tmp_path: Path, kind: str, options: tuple[str, ...]) -> None:
    out = tmp_path / "picture.png"
    code, said = run(kind, run_up, "--from", "1", *options, "--out", out, "--size", "8x6", "--dpi", "50")
    assert (code, said.strip()) == (0, str(out)), said
    assert pixels(out) == (400, 300)


def test_the_same_input_gives_the_same_bytes(faulty: Path, tmp_path: Path) -> None:
    """In another process, with another matplotlibrc."""
    arguments = ["orbit", str(faulty), "--from", "10", "--to", "20", "--size", "4x3", "--out"]
    ours, theirs = ([str(tmp_path / f"{whose}.{suffix}") for suffix in ("png", "svg")] for whose in ("one", "other"))
    for out in ours:
        assert run(*arguments, out)[0] == 0
    (tmp_path / "matplotlibrc").write_text("axes.facecolor: yellow\nfont.size: 20\n", encoding="utf-8")
    environment = {"PATH": "/usr/bin:/bin", "MATPLOTLIBRC": str(tmp_path), "TZ": "Asia/Tokyo"}
    environment["MPLCONFIGDIR"] = get_cachedir()  # where the list of fonts is, which takes seconds to make
    for out in theirs:
        assert ran("service", "plot", *arguments, out, environment=environment).returncode == 0
    for out, other in zip(ours, theirs, strict=True):
        assert Path(out).read_bytes() == Path(other).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("spectrum", "--channel", "x9"), "--channel is 'x9', which is not a channel of demo/lab; expected"),
        (("waterfall", "--channel", "theta"), "--channel is 'theta', which is the shaft angle"),
        (("waterfall", "--channel", "y1", "--channel", "y2"), "a waterfall is of one channel"),
        (("waterfall", "--axis", "speed"), "the speed stays at 1320 rpm"),
        (("waterfall", "--to", "20", "--window", "20"), "1 spectra of demo/lab over 20 s without a gap, expected"),
        (("spectrum", "--window", "nan"), "--window is nan, expected a number above 0"),
        (("spectrum", "--resolution", "900"), "--resolution is 900 Hz, expected at most 250 Hz"),
        (("spectrum", "--to-hz", "1"), "--to-hz is 1, expected at least four lines"),
        (("orbit", "--channel", "y1"), "No such option: --channel"),
        (("trend", "--at", "5"), "No such option: --at"),
        (("trend", "--to", "0.1"), "neither parameter nor level was read in this stretch of time"),
        (("correlation", "--at", "30"), "a window is 60 s, usable data are 30 s"),
        (("correlation", "--machine", "lab"), "name a bundle that has networks, as --machine FILE@BUNDLE"),
        (("correlation", "--at", "soon"), "--at is 'soon', expected seconds after the start"),
        (("orbit", "--from", "20", "--at", "20"), "--at 20: nothing was recorded before that"),
        (("orbit", "--at", "500"), "--at 500: the data end at 2026-01-01 00:01:"),
        (("orbit", "--from", "500"), "nothing was recorded in between"),
        (("orbit", "--from", "65.9", "--revolutions", "9"), "--revolutions is 9, but only"),
        (("orbit", "--key", "demo/fan"), "machines with sample blocks: demo/lab"),
        (("bode",), "a Bode plot needs a run-up or coast-down: the speed stays at 1320 rpm"),
        (("bode", "--order", "4"), "Invalid value for '--order'"),
        (("bode", "--speeds", "fast"), "--speeds is 'fast', expected the slowest and the fastest, rpm"),
        (("bode", "--speeds", "900-600"), "--speeds is '900-600', expected the slowest and the fastest, rpm"),
        (("bode", "--speeds", "600-900"), "--speeds: demo/lab measures the shaft angle"),
        (("waveform", "--window", "0.0001"), "--window is 0.0001 s, expected at least 0.001 s, two samples"),
        (("waveform", "--window", "0"), "--window is 0, expected a number above 0"),
        (("full-spectrum", "--to-hz", "1"), "--to-hz is 1, expected at least four lines"),
        (("centreline", "--clearance", "-1"), "--clearance is -1, expected a number above 0"),
        (("orbit", "--size", "big"), "--size is 'big', expected width x height in inches"),
    ],
)
def test_impossible_plots_are_explained(faulty: Path, tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    out = tmp_path / "picture.png"
    kind, *options = arguments
    code, said = run(kind, faulty, *options, "--out", out)
    assert code in (1, 2)
    assert message in said
    assert not out.exists()


def test_output_files_are_checked_and_not_overwritten(faulty: Path, tmp_path: Path) -> None:
    code, said = run("orbit", faulty, "--out", tmp_path / "orbit.pdf")
    assert (code, "expected a name that ends in .png or .svg" in said) == (2, True)
    out = tmp_path / "orbit.PNG"
    out.write_bytes(b"another picture")
    code, said = run("orbit", faulty, "--out", out)
    assert (code, "already exists; --overwrite replaces it" in said) == (2, True)
    assert out.read_bytes() == b"another picture"
    assert run("orbit", faulty, "--out", out, "--overwrite", "--size", "4x3")[0] == 0
    assert pixels(out)[0] > 0
    code, said = run("orbit", faulty, "--out", tmp_path / "nowhere" / "orbit.png")
    assert (code, "cannot be written" in said) == (2, True)
    code, said = run("orbit", tmp_path / "missing.mcap", "--out", tmp_path / "other.png")
    assert (code, "missing.mcap" in said) == (2, True)


def test_without_a_keyphasor_there_are_spectra_but_no_orbits(without_angle: Path, tmp_path: Path) -> None:
    code, said = run("orbit", without_angle, "--out", tmp_path / "orbit.png")
    assert (code, "has no channel with the shaft angle (keyphasor)" in said) == (2, True)
    code, said = run("waterfall", without_angle, "--axis", "speed", "--window", "2", "--out", tmp_path / "w.png")
    assert (code, "--axis speed needs the shaft angle" in said) == (1, True)
    for kind in ("bode", "polar"):
        code, said = run(kind, without_angle, "--out", tmp_path / f"{kind}.png")
        assert (code, "without it vibration has no phase, and the speed is not known" in said) == (2, True)
    code, said = run("full-spectrum", without_angle, "--window", "2", "--axis", "orders", "--out", tmp_path / "f.png")
    assert (code, "--axis orders needs the shaft angle" in said) == (2, True)
    for kind, *options in (("spectrum",), ("waterfall", "--cascade"), ("full-spectrum",)):
        code, said = run(
            kind, without_angle, "--window", "2", *options, "--size", "4x3", "--out", tmp_path / f"{kind}.png"
        )
        assert code == 0, said


def test_missing_samples_reports_or_descriptor_are_named(faulty: Path, tmp_path: Path) -> None:
    path = write(
        tmp_path / "truth.mcap", [RecordedMessage(LAB.keys.truth, b"{}", b"", "application/json", START_NS, 0)]
    )
    for kind, message in (("trend", "contains no reports or sample blocks"), ("orbit", "contains no sample blocks")):
        code, said = run(kind, path, "--out", tmp_path / "picture.png")
        assert (code, message in said) == (2, True)
    path = write(tmp_path / "bare.mcap", list(read_recording(faulty, keys={LAB.keys.stream}))[:50])
    code, said = run("spectrum", path, "--out", tmp_path / "picture.png")
    assert (code, "no channel descriptor on rotorwatch/demo/lab/descriptor" in said) == (1, True)


def test_without_matplotlib_its_package_is_named(faulty: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # import then fails as without the package
    code, said = run("orbit", faulty, "--out", tmp_path / "orbit.png")
    assert (code, "pip install 'rotorwatch[plots]'" in said) == (2, True)
