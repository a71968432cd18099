"""One scene out of the dataset's ZIP file, from servers of three kinds and from a local file."""

import shutil
import sys
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from recordings import write_recording
from test_faults import assert_refused, contents

from nbtrack.cli import main

pytest.importorskip("remotezip")
SCENE = "breakfast_room"
FETCH = ["data", "fetch", SCENE, "--url"]


class Server(BaseHTTPRequestHandler):
    """Serves one file, by ranges or whole; ends the later of its answers in the middle."""

    content, has_ranges, n_whole = b"", True, 10**9
    sent: list[int]

    def do_GET(self) -> None:
        size, asked = len(self.content), self.headers.get("Range", "") if self.has_ranges else ""
        first, _, last = asked.removeprefix("bytes=").partition("-")
        start = int(first) if first else max(0, size - int(last or size))
        part = self.content[start : int(last) + 1 if first and last else size]
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(len(part)))
        if asked:
            self.send_header("Content-Range", f"bytes {start}-{start + len(part) - 1}/{size}")
        self.end_headers()
        self.sent.append(len(part))
        self.wfile.write(part if len(self.sent) <= self.n_whole else part[: len(part) // 2])
        self.close_connection = True

    def log_message(self, *words: object) -> None:
        """Quiet."""


@pytest.fixture
def serve():
    """Begins to serve a file; returns its address, and the sizes of what will be sent."""
    servers = []

    def begin(file: Path, **options: object) -> tuple[str, list[int]]:
        options |= {"content": file.read_bytes(), "sent": []}
        servers.append(ThreadingHTTPServer(("127.0.0.1", 0), type("", (Server,), options)))
        threading.Thread(target=servers[-1].serve_forever, args=(0.01,)).start()
        return f"http://127.0.0.1:{servers[-1].server_port}/data.zip", options["sent"]

    yield begin
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.fixture
def archive(tmp_path: Path, monkeypatch) -> Path:
    """A ZIP file as the dataset's: two scenes, one folder deeper, with more than is read."""
    monkeypatch.setenv("NBTRACK_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    scene = write_recording("neural_rgbd", tmp_path / "zip/neural_rgbd_data" / SCENE)
    (scene / "depth_with_noise").mkdir()
    noise = np.random.default_rng(0).bytes(100_000)
    (scene / "depth_with_noise/depth0.png").write_bytes(noise)
    shutil.copytree(scene, scene.with_name("kitchen"))
    path = Path(shutil.make_archive(str(tmp_path / "data"), "zip", tmp_path / "zip"))
    with zipfile.ZipFile(path, "a") as file:
        file.writestr("end.bin", noise)  # the end, which holds the directory, is fetched first
    return path


@pytest.fixture
def wanted(archive: Path, tmp_path: Path) -> dict[str, bytes]:
    """What is to be fetched: the files that are read, as they are in the ZIP file."""
    files = contents(tmp_path / "zip/neural_rgbd_data" / SCENE)
    return {name: content for name, content in files.items() if "noise" not in name}


def test_one_scene_by_ranges(archive: Path, tmp_path: Path, wanted, serve, capsys) -> None:
    """Catches a scene that is not as in the ZIP file, folders that nobody reads, other scenes, and
    a ZIP file that is fetched whole; half a file where the connection breaks off, a fetch that
    begins anew, and a file cut short by another program that counts as whole."""
    data = tmp_path / "data"
    assert main([*FETCH, serve(archive, n_whole=6)[0]]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "run the same command again to go on" in line
    kept = {path: path.stat().st_mtime_ns for path in data.rglob("*.*")}
    assert contents(data / SCENE).items() < wanted.items()
    (data / SCENE / "focal.txt").write_text("4")
    kept.pop(data / SCENE / "focal.txt", None)
    assert len(kept) > 0
    address, sent = serve(archive)
    assert main([*FETCH, address]) == 0
    assert contents(data) == {f"{SCENE}/{name}": content for name, content in wanted.items()}
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert sum(sent) < archive.stat().st_size - 200_000  # neither noise nor the other scene
    capsys.readouterr()
    sent.clear()
    assert main([*FETCH, address]) == 0
    assert f"0 files fetched, 0.0 MB; {len(wanted)} were there" in capsys.readouterr().out
    assert sum(sent) <= 64 * 1024  # the directory alone


def test_what_cannot_be_fetched(archive: Path, tmp_path: Path, serve, capsys, monkeypatch) -> None:
    """Catches tracebacks, and a download of all 7 GB, where a server gives no ranges; a file of
    somebody else that is replaced; and images in a ZIP file that does not say of which scene they
    are."""
    page, local = tmp_path / "page.html", [*FETCH, str(archive)]
    page.write_text("<html>moved</html>" * 9000)
    scene = tmp_path / "zip/neural_rgbd_data" / SCENE
    bare = shutil.make_archive(str(tmp_path / "bare"), "zip", scene)
    others = [["data", "fetch", "whiteroom", "--url", file] for file in (str(archive), bare)]
    cases = [
        ([*FETCH, serve(archive, has_ranges=False)[0]], "give its path to --url"),
        *(([*FETCH, place], "not a readable ZIP") for place in (serve(page)[0], str(page))),
        ([*FETCH, "http://127.0.0.1:9/data.zip"], "not a readable ZIP file"),
        ([*FETCH, str(tmp_path / "no.zip")], "no file"),
        *((other, "no images and depth in a folder 'whiteroom'") for other in others),
    ]
    for command, says in cases:
        assert_refused(tmp_path, capsys, command, says)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "remotezip", None)
        assert_refused(tmp_path, capsys, FETCH[:3], "pip install 'nbtrack[fetch]'")
    (tmp_path / "data" / SCENE).mkdir(parents=True)
    (tmp_path / "data" / SCENE / "poses.txt").write_text("my own poses" * 1000)
    assert_refused(tmp_path, capsys, local, "is not the dataset's")  # and nothing is changed


OUTSIDE = [
    "../../out.txt", "images/../../out.png", "..\\out.txt", "images/..\\a.png", "/out.txt",
    "images/.hidden.png", "c:out.txt", "images/a/b.png",
]  # fmt: skip


def test_names_stay_inside(archive: Path, tmp_path: Path, wanted) -> None:
    """Catches an entry whose name leads out of the scene's folder, or hides in it, and a smaller
    folder of the same name that is mixed in."""
    with zipfile.ZipFile(archive, "a") as file:
        for name in OUTSIDE:
            for above in ("", "../neural_rgbd_data/", "neural_rgbd_data/"):
                file.writestr(f"{above}{SCENE}/{name}", b"out")
        file.writestr(f"__MACOSX/{SCENE}/focal.txt", b"other")
    before = contents(tmp_path)
    assert main([*FETCH, str(archive)]) == 0
    fetched = {f"data/{SCENE}/{name}": content for name, content in wanted.items()}
    assert contents(tmp_path) == before | fetched
