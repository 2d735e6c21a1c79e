"""The chart, by Helm itself and Kubernetes' schemas, without a cluster."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from rayfix.cli import make_parser
from rayfix_service.http.access.keys import read_key_file
from rayfix_service.http.settings import BodyLimits
from tests.support.checkout import ROOT

helm_python = pytest.importorskip("helm_python", reason="Helm's library has no wheel for this machine")
kubernetes_validate = pytest.importorskip("kubernetes_validate")

CHART = ROOT / "docker/helm/rayfix"
KUBERNETES = ("1.30", "1.34")
TABLE_ID = "0123456789abcdef" * 4
KEY = "gateway:" + "0123456789abcdef" * 4
FILE = {"name": "hall.glb", "url": "https://store.example/hall.glb?signature=1", "sha256": TABLE_ID}
VALUES: dict[str, dict[str, Any]] = {
    "as it is": {},
    "fetched": {"table": {"source": "url", "url": "https://store.example/hall.h5?signature=1", "id": TABLE_ID}},
    "site in values": {"site": {"toml": "[site]\n", "files": [FILE]}},
    "site in a claim": {"site": {"existingClaim": "sites", "revision": "2"}, "build": {"cluster": "tcp://dask:8786"}},
    "everything": {
        "autoscaling": {"enabled": False},
        "metrics": {"serviceMonitor": True, "keySecret": "monitor"},
        "apiKeys": {"existingSecret": "keys"},
        "service": {"accessLog": True, "rateLimit": 100, "annotations": {"a": "b"}},
        "images": {"service": {"repository": "r/s", "digest": "sha256:" + "0" * 64}, "pullSecrets": [{"name": "p"}]},
        "networkPolicy": {
            "enabled": True,
            "from": [{"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "ingress"}}}],
            "egress": [{"to": [{"ipBlock": {"cidr": "10.0.0.0/8"}}], "ports": [{"port": 8081}]}],
        },
        "ingress": {"enabled": True, "host": "rayfix.example.com", "tlsSecret": "certificate"},
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
    [
        {"tables": {}},
        {"table": {"source": "url"}},
        {"table": {"source": "bucket"}},
        {"service": {"workers": 0}},
        {"site": {"files": [FILE]}},
        {"site": {"toml": "[site]\n", "files": [FILE], "existingClaim": "sites"}},
        {"site": {"toml": "[site]\n", "files": [FILE | {"name": "../hall.glb"}]}},
        {"site": {"toml": "[site]\n", "files": [FILE | {"sha256": ""}]}},
        {"site": {"sceneBase64": "Z2xURg=="}},
        {"ingress": {"enabled": True}},
        {"networkPolicy": {"enable": True}},
        {"images": {"service": {"repository": "r", "digest": "sha256:0"}}},
    ],
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


def policies(values: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Specifications of the network policies by the component that they are for."""
    found = [entry["spec"] for (kind, _), entry in render(values).items() if kind == "NetworkPolicy"]
    return {spec["podSelector"]["matchLabels"]["app.kubernetes.io/component"]: spec for spec in found}


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES)
def test_every_pod_has_a_network_policy(values: dict[str, Any]):
    objects, found = render(values), policies(values)
    for kind, component in (("Deployment", "service"), ("Job", "offline")):
        pods = [entry["spec"]["template"] for (its_kind, _), entry in objects.items() if its_kind == kind]
        for pod in pods:
            selector = found[component]["podSelector"]["matchLabels"]
            assert selector.items() <= pod["metadata"]["labels"].items()
            assert found[component]["policyTypes"] == ["Ingress", "Egress"]
    assert len(found) == len([kind for kind, _ in objects if kind in ("Deployment", "Job")])


def ports(rules: list[dict[str, Any]]) -> list[Any]:
    return [port["port"] for rule in rules for port in rule["ports"]]


def test_the_service_is_asked_on_its_port_and_asks_nobody():
    found = policies({})
    assert found["service"]["ingress"] == [{"ports": [{"port": "http", "protocol": "TCP"}]}]
    assert found["service"]["egress"] == found["offline"]["egress"] == found["offline"]["ingress"] == []
    (container,) = only(render({}), "Deployment")["spec"]["template"]["spec"]["containers"]
    assert "http" in {port["name"] for port in container["ports"]}


def test_what_is_needed_may_be_asked():
    """The table's store or the scheduler on its port, and names; what the values add comes last."""
    for address, port in (
        ("https://store.example/a.h5", 443),
        ("http://store.example/a.h5", 80),
        ("http://store:9000/a.h5?x=:1", 9000),
        ("https://[fd00::1]:9443/a.h5", 9443),
        ("https://[fd00::1]/a.h5", 443),
    ):
        found = policies({"table": {"source": "url", "url": address, "id": TABLE_ID}})
        assert list(found) == ["service"]
        assert ports(found["service"]["egress"]) == [53, 53, port], address
    assert ports(policies({"build": {"cluster": "tcp://dask:8790"}})["offline"]["egress"]) == [53, 53, 8790]
    assert ports(policies({"build": {"cluster": "tcp://dask"}})["offline"]["egress"]) == [53, 53, 8786]
    everything = policies(VALUES["everything"])["service"]
    assert ports(everything["egress"]) == [53, 53, 8081]
    assert everything["ingress"][0]["from"] == VALUES["everything"]["networkPolicy"]["from"]


def test_a_scene_of_any_size_is_fetched_beside_the_site_file():
    """The release and the commands that make it hold the scene's address and hash, whatever its size."""
    second = FILE | {"name": "hall.bin", "url": "http://store:9000/hall.bin"}
    values = {"site": {"toml": "[site]\n", "files": [FILE, second]}}
    pod = only(render(values), "Job")["spec"]["template"]["spec"]
    (fetch,), (build,) = pod["initContainers"], pod["containers"]
    assert fetch["args"] == ["/scene", *FILE.values(), *second.values()]
    (scene,) = (mount for mount in fetch["volumeMounts"] if mount["mountPath"] == "/scene")
    mounts = {mount["mountPath"]: mount for mount in build["volumeMounts"]}
    assert mounts["/site"]["name"] == scene["name"]
    assert mounts["/site/site.toml"]["subPath"] == "site.toml"
    assert ports(policies(values)["offline"]["egress"]) == [53, 53, 443, 9000]


def test_another_signature_of_a_file_is_the_same_table_and_another_file_is_not():
    def job(**changes: str) -> str:
        return str(only(render({"site": {"toml": "[site]\n", "files": [FILE | changes]}}), "Job")["metadata"]["name"])

    assert job(url="https://store.example/hall.glb?signature=2") == job()
    assert job(sha256="f" * 64) != job()


def test_the_ingress_lets_streams_and_batches_through():
    objects = render(VALUES["everything"])
    ingress, service = only(objects, "Ingress"), only(objects, "Service")
    (rule,) = ingress["spec"]["rules"]
    (path,) = rule["http"]["paths"]
    assert path["backend"]["service"]["name"] == service["metadata"]["name"]
    assert path["backend"]["service"]["port"]["name"] in {port["name"] for port in service["spec"]["ports"]}
    assert ingress["spec"]["tls"] == [{"hosts": [rule["host"]], "secretName": "certificate"}]
    nginx = {name.rpartition("/")[2]: value for name, value in ingress["metadata"]["annotations"].items()}
    assert nginx["proxy-buffering"] == "off"
    assert int(nginx["proxy-read-timeout"]) >= 3600 <= int(nginx["proxy-send-timeout"])
    assert int(nginx["proxy-body-size"].removesuffix("m")) << 20 >= BodyLimits().batch
    assert not [kind for kind, _ in render({}) if kind == "Ingress"]


def test_a_pod_may_take_as_long_to_start_as_the_values_say():
    (container,) = only(render({"service": {"startSeconds": 901}}), "Deployment")["spec"]["template"]["spec"][
        "containers"
    ]
    probe = container["startupProbe"]
    assert probe["failureThreshold"] * probe["periodSeconds"] == 900


def test_policies_can_be_left_out():
    assert policies({"networkPolicy": {"enabled": False}}) == {}


def test_images_go_by_digest_where_one_is_given():
    digest = "sha256:" + "1" * 64
    objects = render(
        {"images": {name: {"repository": f"r/{name}", "digest": digest} for name in ("offline", "service")}}
    )
    images = [
        container["image"]
        for kind in ("Deployment", "Job")
        for group in ("initContainers", "containers")
        for container in only(objects, kind)["spec"]["template"]["spec"].get(group, [])
    ]
    assert sorted(images) == [f"r/offline@{digest}", f"r/service@{digest}", f"r/service@{digest}"]


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
