"""Key files that are no files, and ones that become so while the service runs."""

import asyncio
import os
import threading
from pathlib import Path

import pytest

from rayfix_service.http.access.keys import ApiKeys, add_key, read_key_file
from rayfix_service.http.errors import ServiceError


def within(seconds: float, path: Path) -> str:
    """Read a key file in a thread, since it may never end; returns the error's text."""
    texts: list[str] = []

    def read() -> None:
        try:
            read_key_file(path)
        except ServiceError as error:
            texts.append(str(error))

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(seconds)
    assert texts, "it waits for what nobody writes"
    return texts[0]


def test_a_pipe(tmp_path: Path):
    os.mkfifo(tmp_path / "keys")
    assert within(30.0, tmp_path / "keys") == (
        f"the key file {tmp_path / 'keys'} is a named pipe; give a file that 'rayfix api-key NAME -o FILE' has made"
    )
    with pytest.raises(ServiceError, match="is a named pipe"):
        add_key(tmp_path / "keys", "a")


def test_a_device_without_an_end(tmp_path: Path):
    (tmp_path / "keys").symlink_to("/dev/zero")
    assert "is a device; give a file" in within(30.0, tmp_path / "keys")


def test_a_folder_and_a_link_to_nothing(tmp_path: Path):
    assert "is a folder; give a file" in within(30.0, tmp_path)
    (tmp_path / "keys").symlink_to(tmp_path / "nothing")
    assert "cannot be read (No such file or directory); make one" in within(30.0, tmp_path / "keys")


def test_a_huge_file(tmp_path: Path):
    with (tmp_path / "keys").open("wb") as file:
        file.truncate(1 << 40)
    assert "has more than 1048576 bytes; take out keys" in within(30.0, tmp_path / "keys")


def test_a_pipe_in_place_of_the_file_of_a_running_service(tmp_path: Path):
    """The thread that looks at the file is not held up: keys are revoked later, and the process can end."""
    key = add_key(tmp_path / "keys", "a")
    keys = ApiKeys(tmp_path / "keys")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "keys").rename(tmp_path / "former")
    (tmp_path / "pipe").rename(tmp_path / "keys")

    async def reread() -> bool:
        return await asyncio.wait_for(keys.reread(), 30.0)

    with pytest.raises(ServiceError, match="is a named pipe"):
        asyncio.run(reread())
    assert keys.name_of(key) == "a"
    (tmp_path / "keys").unlink()
    add_key(tmp_path / "keys", "b")
    assert asyncio.run(reread())
    assert keys.name_of(key) is None
