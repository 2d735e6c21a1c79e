"""What a compose file says of a service, as a container to run. Every key is either honoured or known not to matter."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from imagetest.containers import Run, Volume

HONOURED = {
    *("image", "command", "entrypoint", "environment", "volumes", "tmpfs", "read_only", "user", "secrets"),
    *("depends_on", "cap_drop", "security_opt"),  # by the script's order, and always
}
WITHOUT_ENGINE = {"build", "ports", "deploy", "restart", "profiles", "stop_grace_period", "healthcheck"}
"""Keys that say how to build, publish, limit and start again: an engine's work."""


@dataclass(frozen=True, kw_only=True)
class Composition:
    """A compose file and where its volumes are.

    Attributes
    ----------
    path : pathlib.Path
    volumes : pathlib.Path
        Folder that holds the named volumes.
    variables : mapping of str to str
        Values of ``${NAME:-default}``.
    """

    path: Path
    volumes: Path
    variables: Mapping[str, str]

    def document(self) -> dict[str, Any]:
        """Return the file's content, variables replaced."""
        text = re.sub(
            r"\$\{(\w+)(?::-([^}]*))?\}",
            lambda match: self.variables.get(match[1], match[2] or ""),
            self.path.read_text(encoding="utf-8"),
        )
        document: dict[str, Any] = yaml.safe_load(text)
        return document

    def run(self, name: str, config: Mapping[str, Any], *, more: tuple[Volume, ...] = ()) -> Run:
        """Return the container of a service.

        Parameters
        ----------
        config : mapping
            The image's own configuration.
        more : tuple of Volume
            Mounts besides the file's.
        """
        service = self.document()["services"][name]
        unknown = set(service) - HONOURED - WITHOUT_ENGINE
        if unknown:
            raise SystemExit(f"{self.path}: this test does not know {sorted(unknown)} of {name}; teach it")
        entrypoint = service.get("entrypoint", config["Entrypoint"])
        command = service.get("command", [] if "entrypoint" in service else config.get("Cmd") or [])
        environment = dict(variable.split("=", 1) for variable in config["Env"])
        user, _, group = str(service.get("user", config["User"])).partition(":")
        return Run(
            command=[str(word) for word in (*entrypoint, *command)],
            environment={**environment, **service.get("environment", {})},
            user=int(user),
            group=int(group),
            folder=config.get("WorkingDir") or "/",
            volumes=(*self._volumes(service), *self._secrets(service), *more),
            tmpfs=dict((entry + ":mode=1777").split(":", 2)[:2] for entry in service.get("tmpfs", ())),
            read_only=service.get("read_only", False),
        )

    def _volumes(self, service: Mapping[str, Any]) -> tuple[Volume, ...]:
        made = []
        for entry in service.get("volumes", ()):
            source, target, *options = entry.split(":")
            path = self.path.parent / source if source.startswith((".", "/")) else self.volumes / source
            made.append(Volume(source=path.resolve(), target=target, read_only="ro" in options))
        return tuple(made)

    def _secrets(self, service: Mapping[str, Any]) -> tuple[Volume, ...]:
        files = self.document().get("secrets", {})
        return tuple(
            Volume(
                source=(self.path.parent / files[name]["file"]).resolve(),
                target=f"/run/secrets/{name}",
                read_only=True,
            )
            for name in service.get("secrets", ())
        )
