"""One scene out of the dataset's ZIP file, from servers of three kinds and from a local file."""

import re
import shutil
import sys
import threading
import zipfile
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from recordings import write_recording
from test_faults import assert_refused

from nbtrack.cli import main
from nbtrack.recordings.reading import read_sequence

pytest.importorskip("remotezip")
SCENE = "breakfast_room"
FETCH = ["data", "fetch", SCENE, "--url"]


class Server(BaseHTTPRequestHandler):
    """Serves one file, by ranges or whole, and may break off an answer."""

    content = b""
    has_ranges = True
    breaks_at = 10**9  # answers that are given; the later ones end in the middle
    n_bytes = n_answers = 0  # sent

    def do_GET(self) -> None:
        kind, size = type(self), len(self.content)
        asked = re.fullmatch(r"bytes=(\d*)-(\d*)", self.headers.get("Range", ""))
        part, status = self.content, 200
        if asked and self.has_ranges:
            first = int(asked[1]) if asked[1] else max(0, size - int(asked[2]))
            last = int(asked[2]) if asked[1] and asked[2] else size - 1
            part, status = self.content[first : last + 1], 206
        self.send_response(status)
        self.send_header("Content-Length", str(len(part)))
        if status == 206:
            self.send_header("Content-Range", f"bytes {first}-{first + len(part) - 1}/{size}")
        self.end_headers()
        kind.n_answers += 1
        kind.n_bytes += len(part)
        self.wfile.write(part if kind.n_answers <= kind.breaks_at else part[: len(part) // 2])
        self.close_connection = True

    def log_message(self, *words: object) -> None:
        """Quiet."""


@pytest.fixture
def serve() -> Iterator[Callable[..., str]]:
    """Begins to serve a file; returns its address."""
    servers = []

    def begin(file: Path, **options: object) -> tuple[str, type[Server]]:
        handler = type("Handler", (Server,), {"content": file.read_bytes(), **options})
        servers.append(ThreadingHTTPServer(("127.0.0.1", 0), handler))
        threading.Thread(target=servers[-1].serve_forever, args=(0.01,)).start()
        return f"http://127.0.0.1:{servers[-1].server_port}/data.zip", handler

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


def fetched(tmp_path: Path) -> dict[str, bytes]:
    """The files of the fetched scene by their paths."""
    folder = tmp_path / "data" / SCENE
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_one_scene_by_ranges(archive: Path, tmp_path: Path, serve, capsys) -> None:
    """Catches a scene that is not as in the ZIP file, folders that nobody reads, other scenes, and
    a ZIP file that is fetched whole; and files that are fetched although they are there."""
    address, server = serve(archive)
    assert main([*FETCH, address]) == 0
    source = tmp_path / "zip/neural_rgbd_data" / SCENE
    files = fetched(tmp_path)
    assert files == {name: (source / name).read_bytes() for name in files}
    assert {name.partition("/")[0] for name in files} == {
        "images", "depth_filtered", "poses.txt", "focal.txt",
    }  # fmt: skip
    assert np.array_equal(
        read_sequence(tmp_path / "data" / SCENE).depths_mm, read_sequence(source).depths_mm
    )
    assert [path.name for path in (tmp_path / "data").iterdir()] == [SCENE]
    assert server.n_bytes < archive.stat().st_size - 200_000  # neither noise nor the other scene
    before = server.n_bytes
    capsys.readouterr()
    assert main([*FETCH, address]) == 0
    assert f"0 files fetched, 0.0 MB; {len(files)} were there" in capsys.readouterr().out
    assert server.n_bytes - before <= 64 * 1024  # the directory alone


def test_a_fetch_goes_on(archive: Path, tmp_path: Path, serve, capsys) -> None:
    """Catches half a file where the connection breaks off, a fetch that begins anew, and a file cut
    short by another program that counts as whole."""
    address, _ = serve(archive, breaks_at=6)
    assert main([*FETCH, address]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "run the same command again to go on" in line
    first = fetched(tmp_path)
    source = tmp_path / "zip/neural_rgbd_data" / SCENE
    assert 0 < len(first) < 14
    assert first == {name: (source / name).read_bytes() for name in first}
    kept = {name: (tmp_path / "data" / SCENE / name).stat().st_mtime_ns for name in first}
    (tmp_path / "data" / SCENE / "focal.txt").write_text("4")
    assert main([*FETCH, serve(archive)[0]]) == 0
    assert len(fetched(tmp_path)) == 14
    assert fetched(tmp_path)["focal.txt"] == (source / "focal.txt").read_bytes()
    for name, time in kept.items():
        if name != "focal.txt":
            assert (tmp_path / "data" / SCENE / name).stat().st_mtime_ns == time


def test_what_cannot_be_fetched(archive: Path, tmp_path: Path, serve, capsys, monkeypatch) -> None:
    """Catches tracebacks, and a download of all 7 GB, where a server gives no ranges; a file of
    somebody else that is replaced; a disk that is filled up to its end; and images in a ZIP file
    that does not say of which scene they are."""
    says = "download the whole file and give its path to --url"
    assert_refused(tmp_path, capsys, [*FETCH, serve(archive, has_ranges=False)[0]], says)
    page = tmp_path / "page.html"
    page.write_text("<html>moved</html>" * 9000)
    for address in (serve(page)[0], str(page), "http://127.0.0.1:9/data.zip"):
        assert_refused(tmp_path, capsys, [*FETCH, address], "not a readable ZIP file")
    assert_refused(tmp_path, capsys, [*FETCH, str(tmp_path / "no.zip")], "no file")
    assert_refused(tmp_path, capsys, ["data", "fetch", "breakfast"], "did you mean")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "remotezip", None)
        assert_refused(tmp_path, capsys, FETCH[:3], "pip install 'nbtrack[fetch]'")
    other = ["data", "fetch", "whiteroom", "--url", str(archive)]
    assert_refused(tmp_path, capsys, other, "has no images and depth in a folder 'whiteroom'")
    bare = shutil.make_archive(
        str(tmp_path / "bare"), "zip", tmp_path / "zip/neural_rgbd_data" / SCENE
    )
    assert_refused(tmp_path, capsys, [*other[:-1], bare], "in a folder 'whiteroom'")
    with monkeypatch.context() as patch:
        patch.setattr("shutil.disk_usage", lambda path: shutil._ntuple_diskusage(9, 8, 1))
        assert_refused(tmp_path, capsys, [*FETCH, str(archive)], "has 0 MB free")
    own = tmp_path / "data" / SCENE / "poses.txt"
    own.parent.mkdir(parents=True)
    own.write_text("my own poses" * 1000)
    assert_refused(tmp_path, capsys, [*FETCH, str(archive)], "is not the dataset's")
    assert own.read_text() == "my own poses" * 1000


def test_names_stay_inside(archive: Path, tmp_path: Path) -> None:
    """Catches an entry whose name leads out of the scene's folder, or hides in it, and a smaller
    folder of the same name that is mixed in."""
    with zipfile.ZipFile(archive, "a") as file:
        for name in (
            "../../out.txt",
            "images/../../out.png",
            "..\\out.txt",
            "images/..\\a.png",
            "/tmp/out.txt",
            "images/.hidden.png",
            "c:out.txt",
            "images/a/b.png",
        ):
            file.writestr(f"{SCENE}/{name}", b"out")
            file.writestr(f"../neural_rgbd_data/{SCENE}/{name}", b"out")
            file.writestr(f"neural_rgbd_data/{SCENE}/{name}", b"out")
        file.writestr(f"__MACOSX/{SCENE}/focal.txt", b"other")
    before = {
        path for path in tmp_path.rglob("*") if "data/" not in str(path.relative_to(tmp_path))
    }
    assert main([*FETCH, str(archive)]) == 0
    assert len(fetched(tmp_path)) == 14
    assert b"o" not in b"".join(v for k, v in fetched(tmp_path).items() if k.endswith(".txt"))
    after = {path for path in tmp_path.rglob("*") if "data/" not in str(path.relative_to(tmp_path))}
    assert after - before <= {tmp_path / "data"}
