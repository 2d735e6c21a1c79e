"""The chart, by Helm itself and Kubernetes' schemas, without a cluster."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from rayfix.cli import make_parser
from rayfix_service.http.access.keys import read_key_file
from tests.support.checkout import ROOT

helm_python = pytest.importorskip("helm_python", reason="Helm's library has no wheel for this machine")
kubernetes_validate = pytest.importorskip("kubernetes_validate")

CHART = ROOT / "docker/helm/rayfix"
KUBERNETES = ("1.30", "1.34")
TABLE_ID = "0123456789abcdef" * 4
KEY = "gateway:" + "0123456789abcdef" * 4
VALUES: dict[str, dict[str, Any]] = {
    "as it is": {},
    "fetched": {"table": {"source": "url", "url": "https://store.example/hall.h5?signature=1", "id": TABLE_ID}},
    "site in values": {"site": {"toml": "[site]\n", "sceneFile": "hall.glb", "sceneBase64": "Z2xURg=="}},
    "site in a claim": {"site": {"existingClaim": "sites", "revision": "2"}, "build": {"cluster": "tcp://dask:8786"}},
    "everything": {
        "autoscaling": {"enabled": False},
        "metrics": {"serviceMonitor": True, "keySecret": "monitor"},
        "apiKeys": {"existingSecret": "keys"},
        "service": {"accessLog": True, "rateLimit": 100, "annotations": {"a": "b"}},
        "images": {"service": {"repository": "r/s", "digest": "sha256:" + "0" * 64}, "pullSecrets": [{"name": "p"}]},
        "podAnnotations": {"a": "b"},
        "nodeSelector": {"disk": "ssd"},
        "tolerations": [{"key": "a", "operator": "Exists"}],
        "affinity": {"nodeAffinity": {}},
        "table": {"claim": {"storageClass": "fast", "accessMode": "ReadWriteOnce"}},
    },
}


def render(values: dict[str, Any], keys: tuple[str, ...] = (KEY,)) -> dict[tuple[str, str], dict[str, Any]]:
    """Objects of the chart by kind and name."""
    values = {"apiKeys": {"hashes": list(keys)}, **values}
    with helm_python.Chart.load(str(CHART)) as chart:
        chart.validate_schema(values)
        files = chart.render(values, name="demo", namespace="prod")
    objects = [
        document for name, text in files.items() if name.endswith(".yaml") for document in yaml.safe_load_all(text)
    ]
    return {(entry["kind"], entry["metadata"]["name"]): entry for entry in objects if entry}


def only(objects: dict[tuple[str, str], dict[str, Any]], kind: str) -> dict[str, Any]:
    (found,) = (entry for (its_kind, _), entry in objects.items() if its_kind == kind)
    return found


def test_helm_finds_nothing_to_object_to():
    found = helm_python.lint(str(CHART))
    assert found["total_charts_linted"] == 1
    assert found["errors"] == []
    assert {message["error"] for message in found["messages"]} <= {"icon is recommended"}


@pytest.mark.parametrize("version", KUBERNETES)
@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES)
def test_objects_are_kubernetes(values: dict[str, Any], version: str):
    objects = render(values)
    assert {"Deployment", "Service", "PodDisruptionBudget"} <= {kind for kind, _ in objects}
    for entry in objects.values():
        if entry["kind"] != "ServiceMonitor":  # the operator's, of which Kubernetes has no schema
            kubernetes_validate.validate(entry, version, strict=True)


def test_the_schema_would_object():
    deployment = only(render({}), "Deployment")
    deployment["spec"]["template"]["spec"]["containers"][0]["livenessProb"] = {}
    with pytest.raises(kubernetes_validate.ValidationError, match="livenessProb"):
        kubernetes_validate.validate(deployment, KUBERNETES[-1], strict=True)


@pytest.mark.parametrize(
    "values",
    [{"tables": {}}, {"table": {"source": "url"}}, {"table": {"source": "bucket"}}, {"service": {"workers": 0}}],
)
def test_values_that_are_none_are_refused(values: dict[str, Any]):
    with pytest.raises(helm_python.HelmValuesError):
        render(values)


def test_selectors_find_the_pods():
    objects = render({})
    labels = only(objects, "Deployment")["spec"]["template"]["metadata"]["labels"]
    job_labels = only(objects, "Job")["spec"]["template"]["metadata"]["labels"]
    for selector in (
        only(objects, "Deployment")["spec"]["selector"]["matchLabels"],
        only(objects, "PodDisruptionBudget")["spec"]["selector"]["matchLabels"],
        only(objects, "Service")["spec"]["selector"],
    ):
        assert selector.items() <= labels.items()
        assert not selector.items() <= job_labels.items()
    assert only(objects, "HorizontalPodAutoscaler")["spec"]["scaleTargetRef"]["name"] == "demo-rayfix"
    assert "replicas" not in only(objects, "Deployment")["spec"]


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES)
def test_pods_are_confined_and_their_commands_are_rayfix(values: dict[str, Any]):
    for entry in render(values).values():
        if entry["kind"] not in {"Deployment", "Job"}:
            continue
        pod = entry["spec"]["template"]["spec"]
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["automountServiceAccountToken"] is False
        for container in pod.get("initContainers", []) + pod["containers"]:
            assert container["securityContext"]["readOnlyRootFilesystem"] is True
            assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
            mounted = {mount["name"] for mount in container["volumeMounts"]}
            assert mounted <= {volume["name"] for volume in pod["volumes"]}
            if "command" in container:
                script = Path(container["command"][1])
                assert (CHART.parents[1] / "image" / script.name).is_file()
            else:
                options = make_parser().parse_args(container["args"])
                assert str(options.tables) == pod["initContainers"][0]["args"][-1]
                assert any(options.api_keys.is_relative_to(mount["mountPath"]) for mount in container["volumeMounts"])


def test_a_change_of_the_site_makes_a_new_table():
    first, same, changed = (
        render({"site": {"toml": text}})
        for text in ("[site]\nname = 'a'\n", "[site]\nname = 'a'\n", "[site]\nname = 'b'\n")
    )
    assert first == same
    assert only(first, "Job")["metadata"]["name"] != only(changed, "Job")["metadata"]["name"]

    def file(objects: dict[tuple[str, str], dict[str, Any]]) -> tuple[str, str]:
        (variable,) = only(objects, "Job")["spec"]["template"]["spec"]["containers"][0]["env"]
        waited = only(objects, "Deployment")["spec"]["template"]["spec"]["initContainers"][0]["args"]
        return variable["value"], waited[0]

    assert file(first)[1] == f"/tables/{file(first)[0]}"
    assert file(first)[0] != file(changed)[0]


def test_a_service_without_keys_is_refused():
    with pytest.raises(helm_python.HelmError, match="rayfix api-key NAME"):
        render({}, keys=())


def test_the_secret_is_a_key_file(tmp_path: Path):
    other = KEY.replace("gateway", "other")
    path = tmp_path / "keys"
    path.write_text(only(render({}, keys=(KEY, other)), "Secret")["stringData"]["api_keys"], encoding="utf-8")
    assert set(read_key_file(path)) == {"gateway", "other"}
