"""The compose file, Prometheus' files and the dashboard, against what the service really has."""

import hashlib
import json
import re
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from imagetest.composition import HONOURED, WITHOUT_ENGINE, Composition
from rayfix.cli import make_parser
from rayfix_service.fusion.measurements.report import Angle, Range, Report
from rayfix_service.fusion.posterior.fix import Candidate, Fix, Outcome, Status
from rayfix_service.http.access.keys import ApiKeys
from rayfix_service.http.telemetry.metrics import Metrics
from rayfix_service.http.telemetry.report_figures import ReportOutcome
from rayfix_service.http.telemetry.station_figures import OUTCOMES
from rayfix_tables.site import SiteInfo, Station
from tests.support.checkout import ROOT

DOCKER = ROOT / "docker"
CONFIG = {"Entrypoint": ["python", "start.py"], "Cmd": ["--help"], "Env": ["A=1", "B=x=y"], "User": "10001:10001"}


@pytest.fixture(scope="module")
def composition() -> Composition:
    return Composition(path=DOCKER / "compose.yaml", volumes=Path("/volumes"), variables={})


@pytest.fixture(scope="module")
def services(composition: Composition) -> dict[str, Any]:
    return composition.document()["services"]


def test_up_builds_then_serves_then_locates(services: dict[str, Any]):
    assert services["service"]["depends_on"] == {"build-tables": {"condition": "service_completed_successfully"}}
    assert services["first-fix"]["depends_on"] == {"service": {"condition": "service_healthy"}}
    assert {name for name, service in services.items() if "profiles" not in service} == {
        *("build-tables", "service", "first-fix"),
    }
    targets = {name: service["build"]["target"] for name, service in services.items() if "build" in service}
    assert targets == {"build-tables": "offline", "service": "service"}


def test_every_container_is_confined(services: dict[str, Any]):
    for name, service in services.items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        for port in service.get("ports", ()):
            assert port.startswith("127.0.0.1:"), name
        if name != "first-fix":  # it ends at once
            assert service["deploy"]["resources"]["limits"]["memory"], name


def test_images_may_be_named_by_digest():
    names = {"OFFLINE", "SERVICE", "PROMETHEUS", "MOSQUITTO"}
    digests = {f"RAYFIX_{name}_IMAGE": f"r/{name.lower()}@sha256:{'0' * 64}" for name in names}
    named = Composition(path=DOCKER / "compose.yaml", volumes=Path("/volumes"), variables=digests)
    assert {service["image"] for service in named.document()["services"].values()} == set(digests.values())


def test_every_key_is_known(services: dict[str, Any]):
    assert {key for service in services.values() for key in service} <= HONOURED | WITHOUT_ENGINE


def test_the_commands_are_those_of_the_command_line(services: dict[str, Any]):
    options = make_parser().parse_args(services["service"]["command"])
    assert (options.host, options.port, options.api_keys) == ("0.0.0.0", 8000, Path("/run/secrets/api_keys"))
    options = make_parser().parse_args(services["mqtt"]["command"])
    assert options.broker in services["mqtt"]["depends_on"]


def test_a_service_becomes_a_container(composition: Composition):
    run = composition.run("service", CONFIG)
    assert run.command[:4] == ["python", "start.py", "serve", "/tables/site.h5"]
    assert run.environment == {"A": "1", "B": "x=y"}
    assert (run.user, run.group, run.read_only) == (10001, 10001, True)
    assert run.tmpfs == {"/tmp": "size=256m,mode=1777"}
    mounted = {volume.target: (volume.source, volume.read_only) for volume in run.volumes}
    assert mounted == {
        "/tables": (Path("/volumes/tables"), True),
        "/run/secrets/api_keys": (DOCKER / "secrets/api_keys", True),
    }
    run = composition.run("first-fix", CONFIG)
    assert run.command == ["python", "/opt/rayfix/bin/first_fix.py"]


def test_the_key_that_comes_along_opens(composition: Composition):
    files = composition.document()["secrets"]
    key = (DOCKER / files["api_key"]["file"]).read_text(encoding="utf-8").strip()
    assert ApiKeys(DOCKER / files["api_keys"]["file"]).name_of(key) == "demo"
    assert ApiKeys(DOCKER / files["api_keys"]["file"]).name_of(hashlib.sha256(key.encode()).hexdigest()) is None


@pytest.fixture(scope="module")
def figures() -> dict[str, set[str]]:
    """Labels of each figure that a service has, by the names of its samples."""
    metrics = Metrics()
    metrics.request_done("/v1/positions", "POST", "200", 0.01)
    metrics.request_done("/v1/positions", "POST", "503", 0.01)
    measured = (
        Angle(station_id="a", azimuth=0.0, azimuth_stdev=0.1),
        Range(station_id="a", path_length=1.0, stdev=0.1),
    )
    fix = Fix(
        status="ok",
        candidates=(Candidate(probability=1.0, position=np.ones(3), covariance=np.eye(3)),),
        outcomes=(Outcome(used=True, outlier_probability=0.1),) * 2,
        log_evidence=0.0,
        table_id="",
    )
    station = Station(id="a", position=(0.0, 0.0, 0.0))
    site = SiteInfo(name="site", north=0.0, max_path_length=100.0, stations=(station,))
    metrics.fix_done(fix, 0.01, table="site", site=site, report=Report(measurements=measured))
    metrics.broker_connected("broker:1883", True)
    text, _ = metrics.exposition("text/plain")
    found: dict[str, set[str]] = {"up": {"job", "instance"}}
    for family in text_string_to_metric_families(text.decode()):
        for sample in family.samples:
            found.setdefault(sample.name, {"job", "instance"}).update(sample.labels)
    # It has no table and so no labels of one.
    found["rayfix_table_info"] = {"job", "instance", "table", "table_id", "site", "format_version", "software_version"}
    return found


def expressions() -> list[str]:
    alerts = yaml.safe_load((DOCKER / "prometheus/alerts.yml").read_text(encoding="utf-8"))
    found = [rule["expr"] for group in alerts["groups"] for rule in group["rules"]]
    dashboard = json.loads((DOCKER / "grafana/rayfix.json").read_text(encoding="utf-8"))
    return found + [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]


@pytest.mark.parametrize("expression", expressions())
def test_alerts_and_panels_ask_for_figures_that_are_there(expression: str, figures: dict[str, set[str]]):
    asked = re.findall(r"\b(up|rayfix_\w+)(?:\{([^}]*)\})?", expression)
    assert asked
    for name, selector in asked:
        assert name in figures
        for label, value in re.findall(r'(\w+)\s*=~?\s*"([^"]*)"', selector):
            assert label in figures[name]
            if label == "status" and name == "rayfix_fixes_total":
                assert value in get_args(Status)
            if label == "outcome":
                known = get_args(ReportOutcome) if name == "rayfix_reports_total" else (*OUTCOMES, "loaded", "refused")
                assert set(value.split("|")) <= set(known)
    for labels in re.findall(r"\bby \(([^)]*)\)", expression):
        assert {label.strip() for label in labels.split(",")} <= set.union(*(figures[name] for name, _ in asked))


def test_what_is_asked_of_single_routes_is_asked_of_all():
    """Batches and streams are answered 200 whatever becomes of their reports, and the broker has no route."""
    assert not any("route=" in expression for expression in expressions())
    alerts = yaml.safe_load((DOCKER / "prometheus/alerts.yml").read_text(encoding="utf-8"))
    by_name = {rule["alert"]: rule["expr"] for group in alerts["groups"] for rule in group["rules"]}
    for name in ("RayfixReportsFail", "RayfixReportsRefused", "RayfixSlow"):
        assert "by (instance, source" in by_name[name]


def test_prometheus_reads_alerts_and_key(services: dict[str, Any]):
    settings = yaml.safe_load((DOCKER / "prometheus/prometheus.yml").read_text(encoding="utf-8"))
    for file in settings["rule_files"]:
        assert (DOCKER / "prometheus" / file).is_file()
    (job,) = settings["scrape_configs"]
    assert job["job_name"] == "rayfix"  # the alerts' up{job="rayfix"}
    assert job["authorization"]["credentials_file"].removeprefix("/run/secrets/") in services["prometheus"]["secrets"]
    assert job["static_configs"][0]["targets"] == ["service:8000"]
