"""The page's server as ``dahl-ident app`` starts it, and what a browser would send to it."""

from __future__ import annotations

import http.client
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from types import MappingProxyType
from urllib.parse import urlencode, urlsplit

Headers = Mapping[str, str | None]


class Server:
    """A running server and its address."""

    def __init__(self, folder: Path, address: str) -> None:
        self.folder, self.address = folder, address
        self.port = int(urlsplit(address).port or 0)
        self.headers = {"Host": f"127.0.0.1:{self.port}"}
        answer = self.request("GET", address.partition(str(self.port))[2])
        self.headers["Cookie"] = answer[1]["set-cookie"].partition(";")[0]

    def request(
        self, method: str, path: str, body: bytes = b"", headers: Headers = MappingProxyType({})
    ) -> tuple[int, Mapping[str, str], str]:
        """Return status, headers and text of an answer; a header of None is not sent."""
        sent = dict(self.headers)
        if method == "POST":
            sent |= {"Origin": f"http://127.0.0.1:{self.port}", "Content-Length": str(len(body))}
        sent |= {name: value or "" for name, value in headers.items()}
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)) as server:
            server.putrequest(method, path, skip_host=True)
            for name, value in sent.items():
                if value:
                    server.putheader(name, value)
            server.endheaders(body)
            with server.getresponse() as answer:
                found = {name.lower(): value for name, value in answer.getheaders()}
                return answer.status, found, answer.read().decode(errors="replace")

    def upload(self, files: Sequence[tuple[str, bytes]], to: str = "/") -> str:
        """Send files as a form does, and return where it leads."""
        parts = [
            b'--x\r\nContent-Disposition: form-data; name="files"; filename="'
            + name.encode()
            + b'"\r\n\r\n'
            + content
            + b"\r\n"
            for name, content in files
        ]
        body = b"".join(parts) + b"--x--\r\n"
        status, headers, text = self.request(
            "POST", to, body, {"Content-Type": "multipart/form-data; boundary=x"}
        )
        assert status == 303, text
        return headers["location"]

    def send(self, path: str, **fields: str) -> str:
        """Send a form, and return where it leads."""
        status, headers, text = self.request(
            "POST", path, urlencode(fields).encode(),
            {"Content-Type": "application/x-www-form-urlencoded"},
        )  # fmt: skip
        assert status == 303, text
        return headers["location"]

    def page(self, path: str) -> str:
        """Return the text of a page."""
        status, _, text = self.request("GET", path)
        assert status == 200, text
        return text

    def fitted(self, work: str, **fields: str) -> str:
        """Start a fit with the model form, wait for its end and return its address."""
        run = self.send(f"{work}/model", **{"law": "dahl", **fields})
        self.wait(run)
        return run

    def wait(self, run: str, seconds: float = 240.0) -> None:
        """Wait until nothing runs."""
        end = time.monotonic() + seconds
        while '"busy":true' in self.page(f"{run}/state"):
            assert time.monotonic() < end, self.page(run)
            time.sleep(0.05)


@contextmanager
def started(folder: Path, *options: str) -> Iterator[Server]:
    """Start a server for the work in a folder."""
    child = subprocess.Popen(
        [sys.executable, "-m", "dahl_ident.cli", "app", str(folder), "--no-browser", *options],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    try:
        yield Server(folder, child.stdout.readline().strip())
    finally:
        child.terminate()
        child.wait()
        child.stdout.close()
