"""Public measurements by name, from a server on this machine: whole, wrong, cut, silent, absent; and where names go."""

import contextlib
import hashlib
import http.server
import re
import socket
import threading
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from conftest import measured, refused

import coopoc as co
from coopoc.cli import _status
from coopoc.data import commands  # noqa: F401  binds the registry before a test replaces it
from coopoc.data import fetch as fetching
from coopoc.data.fetch import Entry, public
from coopoc.data.registry import kind_of
from coopoc.data.registry import read_log as load_log
from coopoc.world.storage import digest

DRIVE = "t,vehicle,x,y,vx,vy\n" + "".join(f"{t},a,{9 * t},0,9,0\n" for t in range(4000))


@dataclass
class Server:
    """What a server has, how it behaves, and what it was asked.

    Args:
        files: path -> bytes.
        cut: bytes of the body after which it closes each connection, None for never.
        silent: "" or the part, "all" or "body", that it never sends.
        asked: path of each request.
    """

    files: dict[str, bytes]
    cut: int | None = None
    silent: str = ""
    asked: list[str] = field(default_factory=list)
    address: str = ""


@pytest.fixture
def server():
    state, over = Server({}), threading.Event()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            state.asked.append(self.path)
            if state.silent == "all":
                over.wait()
                return
            data = state.files.get(self.path)
            if data is None:
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data[: state.cut])
            self.wfile.flush()
            if state.silent == "body":
                over.wait()

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as served:
        threading.Thread(target=served.serve_forever, daemon=True).start()
        state.address = f"http://127.0.0.1:{served.server_port}"
        yield state
        over.set()
        served.shutdown()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("COOPOC_DATA", str(tmp_path / "cache"))
    monkeypatch.delenv("COOPOC_MIRROR", raising=False)
    return tmp_path / "cache"


def entry(name, files, address="", **more: str):
    rows = {f: (f"{address}/{f}", len(data), hashlib.sha256(data).hexdigest()) for f, data in files.items()}
    return Entry(name, "a car", "MIT", "An author, 2026", "https://example.org/page", "not tried", rows, **more)


@pytest.fixture
def car(cache, server, monkeypatch):
    """A data set of one drive, which the server has as its project would."""
    data = DRIVE.encode()
    server.files["/drive.csv"] = data
    made = {"car": entry("car", {"drive.csv": data}, server.address, opens="drive.csv")}
    monkeypatch.setattr(fetching, "public", lambda: made)
    return data


def test_a_data_set_is_fetched_once_and_read_by_name(car, cache, server, capsys):
    with refused("Run coopoc data get car"):
        co.load_fleet("car")
    path = co.fetch("car")
    assert path == cache / "car" / "drive.csv"
    assert path.read_bytes() == car
    assert co.fetch("car") == path
    assert server.asked == ["/drive.csv"]
    assert capsys.readouterr().err == ""
    assert digest(co.read_log("car").recording) == digest(co.read_log(path).recording)
    assert len(co.read_log("car?until=100").recording.t) == 100
    assert kind_of("car") == "log"


def test_a_local_path_goes_before_a_name(car, cache, tmp_path, monkeypatch):
    (tmp_path / "car").mkdir()
    (tmp_path / "car" / "mine.csv").write_text("\n".join(DRIVE.splitlines()[:10]))
    monkeypatch.chdir(tmp_path)
    assert len(load_log("car").recording.t) == len(load_log("car?dt=1").recording.t) == 9


def test_one_wrong_byte_is_refused_with_both_hashes_and_removed(car, cache, server):
    wrong = b"T" + car[1:]
    server.files["/drive.csv"] = wrong
    with refused(f"{hashlib.sha256(wrong).hexdigest()}.*{hashlib.sha256(car).hexdigest()}.*removed"):
        co.fetch("car")
    assert [path.name for path in (cache / "car").iterdir()] == [".lock"]
    for other in (b"<html>log in</html>", car + bytes(10**6)):
        server.files["/drive.csv"] = other
        with refused("must have SHA-256"):
            co.fetch("car")
    server.files["/drive.csv"] = car
    assert co.fetch("car").read_bytes() == car


def test_a_connection_that_breaks_is_named_and_the_next_call_begins_anew(car, cache, server):
    server.cut = len(car) // 5
    with refused(f"closed the connection after {server.cut} of {len(car)} bytes.*save it as {cache}/car/drive.csv"):
        co.fetch("car")
    assert [path.name for path in (cache / "car").iterdir()] == [".lock"]
    server.cut = None
    assert co.fetch("car").read_bytes() == car
    (cache / "car" / "drive.csv").write_bytes(b"damaged since")
    assert co.fetch("car").read_bytes() == car


@pytest.mark.parametrize("silent", ["all", "body"])
def test_a_silent_server_is_given_up(car, server, silent, capsys, monkeypatch):
    monkeypatch.setattr(fetching, "TIMEOUT", 0.5)
    server.silent, server.cut, began = silent, 100, time.perf_counter()
    assert _status(["data", "get", "car"]) == 2
    assert time.perf_counter() - began < 5
    told = capsys.readouterr().err
    assert f"{server.address}/drive.csv: was not fetched: sent nothing for 0.5 s. Fetch it by hand" in told
    assert len(told.strip().splitlines()) == 1


def test_no_network_and_a_missing_page_name_address_and_place(car, cache, server, monkeypatch):
    with contextlib.closing(socket.socket()) as unused:
        unused.bind(("127.0.0.1", 0))
        monkeypatch.setenv("COOPOC_MIRROR", f"http://127.0.0.1:{unused.getsockname()[1]}")
        again = f"example.org/page.*save it as {cache}/car/drive.csv, and run coopoc data get car again"
        with refused(f"/drive.csv: was not fetched: .*refused.*{again}"):
            co.fetch("car")
    monkeypatch.setenv("COOPOC_MIRROR", server.address)
    with refused("404"):
        co.fetch("car")
    with refused("Did you mean car"):
        co.fetch("cra")
    monkeypatch.setenv("COOPOC_DATA", str(cache / "car" / ".lock"))
    with refused("COOPOC_DATA = .*must be a folder that can be written"):
        co.fetch("car")
    assert _status(["data", "get"]) == 2


def test_a_file_that_is_placed_by_hand_is_verified(car, cache, server):
    server.files = {}
    place = cache / "car" / "drive.csv"
    place.parent.mkdir(parents=True)
    place.write_bytes(b"another")
    with refused(f"404.*there has SHA-256 {hashlib.sha256(b'another').hexdigest()}"):
        co.fetch("car")
    place.write_bytes(car)
    assert co.fetch("car") == place


def test_a_mirror_serves_a_copy_of_the_folder(car, cache, server, monkeypatch):
    server.files = {"/lab/car/drive.csv": car}
    monkeypatch.setenv("COOPOC_MIRROR", f"{server.address}/lab/")
    assert co.fetch("car").read_bytes() == car


def test_files_of_an_archive_are_verified_one_by_one(cache, server, tmp_path, monkeypatch):
    files = {"set/a.csv": DRIVE.encode(), "set/b.csv": b"t,x\n"}
    made = entry("zipped", files, archive=f"{server.address}/all.zip", opens="set")
    monkeypatch.setattr(fetching, "public", lambda: {"zipped": made})

    def serve(members):
        with zipfile.ZipFile(tmp_path / "all.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in members.items():
                archive.writestr(name, data)
        server.files["/all.zip"] = (tmp_path / "all.zip").read_bytes()

    serve({"else/a.csv": files["set/a.csv"], "else/b.csv": b"T,x\n", "../evil": b"x"})
    with refused(f"{hashlib.sha256(b'T,x' + bytes([10])).hexdigest()}.*must have SHA-256.*removed"):
        co.fetch("zipped")
    assert not (cache / "zipped" / "set" / "b.csv").exists()
    serve({"a.csv": files["set/a.csv"]})
    with refused("b.csv is not in it.*unpack it in"):
        co.fetch("zipped")
    server.files["/all.zip"] = b"no archive"
    with refused("not a zip file"):
        co.fetch("zipped")
    serve({"else/b.csv": b"t,x\n"})
    assert co.fetch("zipped") == cache / "zipped" / "set"
    assert sorted(path.name for path in (cache / "zipped").rglob("*") if path.is_file()) == [".lock", "a.csv", "b.csv"]


def test_the_registry_is_complete_and_pins_every_address(cache, capsys):
    for one in public().values():
        assert all((one.what, one.licence, one.citation, one.tried))
        assert one.page.startswith("http")
        for address, size, sha in one.files.values():
            assert size > 0
            assert re.fullmatch("[0-9a-f]{64}", sha)
            assert re.search("/[0-9a-f]{40}/", address) or (not address and one.archive.endswith(".zip"))
    for command in (["list"], ["show", "f9k"]):
        assert _status(["data", *command]) == 0
    told = capsys.readouterr().out
    assert all(f"| {name} " in told for name in public())
    assert "coopoc data get f9k" in told


def test_drives_with_carlas_axes_under_other_names_are_read(tmp_path):
    """As those of the paper, which are behind a login."""
    rows = [f"{car},{t / 10},{t},{t - car},0,8,2,0" for t in range(5) for car in range(60)]
    (tmp_path / "a.csv").write_text("\n".join(["car,time,px,py,pz,u,v,w", *rows]))
    fleet = co.load_fleet(f"{tmp_path}/a.csv?columns=id:car,t:time,x:px,y:py,z:pz,vx:u,vy:v,vz:w&scale=y:-1,vy:-1")
    assert fleet.position[2, fleet.index("7")].tolist() == [2, 5, 0]


@pytest.mark.parametrize("name", public())
def test_the_registry_has_the_hashes_of_what_the_pages_were_computed_from(name, cache, tmp_path, monkeypatch):
    """Through a mirror made of the files; what it returns is read by the commands that take it."""
    for file in public()[name].files:
        source = measured("/".join(Path(file).parts[-3:]))
        copy = tmp_path / "mirror" / name / file
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.symlink_to(source)
    monkeypatch.setenv("COOPOC_MIRROR", (tmp_path / "mirror").as_uri())
    path = co.fetch(name)
    assert path.exists()
    if name.startswith("mrclam-set"):
        assert len(co.load_fleet(name).ids) == 5
    elif path.suffix == ".pyfg":
        assert repr(co.read_graph(name)) == repr(co.read_graph(path))
    elif name in ("f9k", "comma2k19", "labyrinth"):
        assert load_log(name + {"comma2k19": "?dt=0.1", "labyrinth": "?frame=body"}.get(name, "")).truth is not None


def test_a_folder_of_several_drives_is_refused_and_lists_them(tmp_path):
    rows = DRIVE.splitlines()
    for name, begin in {"monday": 0, "tuesday": 90000, "friday": 1580000000}.items():
        table = [f"{begin + t}{row[row.index(',') :]}" for t, row in enumerate(rows[1:50])]
        (tmp_path / name).mkdir()
        (tmp_path / name / "m.csv").write_text("\n".join([rows[0], *table]))
    with refused("monday/m.csv: 0 to 48 s; tuesday/m.csv: 90000 to 90048 s; friday/m.csv.*a folder of its own"):
        co.read_log(tmp_path)


def test_vehicles_that_come_later_are_of_one_drive(tmp_path):
    rows = DRIVE.splitlines()
    (tmp_path / "a.csv").write_text("\n".join(rows[:2000]))
    (tmp_path / "b.csv").write_text("\n".join([rows[0], *[row.replace(",a,", ",b,") for row in rows[2500:]]]))
    assert co.read_log(tmp_path).recording.ids == ("a", "b")


@pytest.mark.parametrize("name", ["truth.csv", "span_truth.csv", "GroundTruth.csv", "car_GT.csv"])
def test_a_file_with_the_name_of_a_truth_is_one(name, tmp_path):
    (tmp_path / "car.csv").write_text(DRIVE)
    (tmp_path / name).write_text("\n".join(",".join(row.split(",")[:4]) for row in DRIVE.splitlines()))
    log = co.read_log(tmp_path)
    assert log.recording.ids == ("a",)
    assert np.isfinite(log.truth.position).all()


def test_what_is_missing_names_the_command_that_brings_it(cache, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for words, name in {
        "run real": "mrclam-set6",
        "run real --data MRCLAM_Dataset7": "mrclam-set7",
        "run real --data tiers.pyfg": "tiers",
        "run side_by_side --data f9k": "f9k",
        "data check Indoor_UWB_Input.txt": "labyrinth",
        "solve plaza1": "plaza1",
    }.items():
        assert _status(words.split()) == 2, words
        assert f"Run coopoc data get {name}." in capsys.readouterr().err
    for method, tasks in {"cooperative-filter": "f9k kitti comma2k19", "pose-solo": "robots uwb indoor"}.items():
        assert _status(["benchmark", method, "--tasks", *tasks.split()]) == 1
        told = capsys.readouterr().err
        names = ("f9k", "kitti00", "comma2k19") if "filter" in method else ("mrclam-set6", "tiers", "labyrinth")
        assert all(f"Run coopoc data get {name}." in told for name in names)
    assert _status(["benchmark", "cooperative-filter", "--tasks", "robots"]) == 2
    assert "f9k, kitti, comma2k19" in capsys.readouterr().err


def test_a_task_of_real_measurements_runs_alone(cache, tmp_path, capsys):
    measured("span_truth.gga")
    folder = measured("ublox_f9k.nmea").parent
    words = ["benchmark", "cooperative-filter", "--tasks", "f9k", "--data", str(folder), "--out", str(tmp_path)]
    assert _status(words) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "cooperative-filter" in line]
    assert len(rows) == 1
    assert "| f9k " in rows[0]
    assert "0.594 [0.523, 0.671]" in rows[0]  # docs/benchmark.md
