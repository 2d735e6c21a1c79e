"""The proxies' examples: a real nginx with TLS before a real service, and the form of Caddy's file."""

import json
import re
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.sync.client import connect

from tests.support.checkout import ROOT
from tests.support.messages.reports import REPORT
from tests.support.running.server_process import start_rayfix_serve

PROXY = ROOT / "docker" / "proxy"

FRAME = """\
daemon off;
master_process off;
pid {folder}/nginx.pid;
error_log stderr;
events {{}}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
    include {folder}/rayfix.conf;
}}
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def replaced(text: str, changes: dict[str, str]) -> str:
    for old, new in changes.items():
        assert text.count(old) >= 1, old
        text = text.replace(old, new)
    return text


@pytest.fixture(scope="module")
def proxied(hall_table_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Client of an nginx with the example's configuration, but for names, ports and the certificate."""
    nginx, openssl = shutil.which("nginx") or shutil.which("/usr/sbin/nginx"), shutil.which("openssl")
    if nginx is None or openssl is None:
        pytest.skip("nginx or openssl is not installed")
    folder = tmp_path_factory.mktemp("nginx")
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    files = ["-keyout", str(folder / "key"), "-out", str(folder / "certificate")]
    new = [openssl, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", *names, *files]
    subprocess.run(new, check=True, capture_output=True)
    port = free_port()
    with start_rayfix_serve(hall_table_path, "--root-path", "/rayfix") as server:
        changes = {
            "127.0.0.1:8000": server.url.removeprefix("http://"),
            "listen 443 ssl": f"listen 127.0.0.1:{port} ssl",
            "example.com;": "localhost;",
            "/etc/nginx/tls/example.com.crt": str(folder / "certificate"),
            "/etc/nginx/tls/example.com.key": str(folder / "key"),
        }
        text = replaced((PROXY / "nginx.conf").read_text(encoding="utf-8"), changes)
        (folder / "rayfix.conf").write_text(text, encoding="utf-8")
        (folder / "nginx.conf").write_text(FRAME.format(folder=folder), encoding="utf-8")
        process = subprocess.Popen([nginx, "-p", str(folder), "-c", str(folder / "nginx.conf")])
        try:
            trusted = ssl.create_default_context(cafile=str(folder / "certificate"))
            with httpx.Client(
                base_url=f"https://localhost:{port}", verify=trusted, trust_env=False, timeout=20
            ) as client:
                client.headers["x-test-certificate"] = str(folder / "certificate")
                wait_for(client, process)
                yield client
        finally:
            process.terminate()
            process.wait(20)


def wait_for(client: httpx.Client, process: "subprocess.Popen[bytes]") -> None:
    for _ in range(200):
        assert process.poll() is None, "nginx has ended"
        try:
            client.get("/rayfix/livez")
        except httpx.ConnectError:
            time.sleep(0.05)
        else:
            return
    pytest.fail("nginx does not answer")


def test_requests_below_the_prefix(proxied: httpx.Client):
    assert proxied.post("/rayfix/v1/positions", json=REPORT).json()["status"] == "ok"
    assert proxied.get("/rayfix/openapi.json").json()["servers"] == [{"url": "/rayfix"}]
    assert proxied.get("/rayfix/").status_code == 200
    folder = proxied.get("/rayfix?a=1")
    assert folder.status_code == 308
    assert folder.headers["location"].endswith("/rayfix/?a=1")
    assert proxied.get("/v1/table").status_code == 404


def test_a_web_socket_passes(proxied: httpx.Client):
    trusted = ssl.create_default_context(cafile=proxied.headers["x-test-certificate"])
    url = str(proxied.base_url).replace("https", "wss").rstrip("/")
    origin: Any = str(proxied.base_url).rstrip("/")
    with connect(f"{url}/rayfix/v1/stream", ssl=trusted, origin=origin, proxy=None) as stream:
        for _ in range(2):
            stream.send(json.dumps(REPORT))
            assert json.loads(stream.recv(timeout=20))["status"] == "ok"


def test_events_pass_at_once(proxied: httpx.Client):
    with proxied.stream("GET", "/rayfix/v1/fixes") as feed:
        lines = feed.iter_lines()
        assert next(lines).startswith("retry:")
        proxied.post("/rayfix/v1/positions", json={**REPORT, "target_id": "through-nginx"})
        data = next(line for line in lines if line.startswith("data:"))
    assert json.loads(data.removeprefix("data:"))["fix"]["target_id"] == "through-nginx"


def test_the_file_of_caddy_is_well_formed():
    """Caddy is no package of Debian's; its own check runs where it is installed."""
    path = PROXY / "Caddyfile"
    text = path.read_text(encoding="utf-8")
    bare = "\n".join(re.sub(r"(^|\s)#.*", "", line) for line in text.splitlines())
    depth = 0
    for line in filter(None, map(str.strip, bare.splitlines())):
        depth -= line == "}"
        assert depth >= 0
        assert "}" not in line.removesuffix("}") or line.count("{") == line.count("}"), line
        depth += line.endswith("{")
        assert not line.endswith(";"), "Caddy ends no line so"
    assert depth == 0
    for part in (
        "handle_path /rayfix/*",
        "reverse_proxy 127.0.0.1:8000",
        "redir /rayfix /rayfix/ 308",
        "flush_interval -1",
    ):
        assert part in bare
    if (caddy := shutil.which("caddy")) is not None:
        subprocess.run([caddy, "validate", "--adapter", "caddyfile", "--config", str(path)], check=True)
