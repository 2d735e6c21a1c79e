"""The version of the software, as installed."""

from importlib.metadata import PackageNotFoundError, version


def software_version() -> str:
    """Version of the installed package, "0+unknown" when it runs from a folder that is not installed."""
    try:
        return version("rayfix")
    except PackageNotFoundError:
        return "0+unknown"
