"""Options of ``rayfix serve`` for an MQTT broker: those of ``rayfix mqtt``, each with the prefix ``--mqtt-``."""

import argparse
import os
from typing import TYPE_CHECKING

from rayfix.commands.arguments import at_least_one, probability
from rayfix.errors import SettingsError
from rayfix.extras import needs_extra

if TYPE_CHECKING:
    from rayfix_service.adapters.mqtt.settings import MqttSource

PASSWORD_VARIABLE = "RAYFIX_MQTT_PASSWORD"
"""Environment variable of the password; not an argument, which other users of the machine could read."""


def add_service_broker_arguments(command: argparse.ArgumentParser) -> None:
    """Add the options to the command that serves."""
    group = command.add_argument_group("positions from an MQTT broker, as of 'rayfix mqtt'")
    group.add_argument(
        "--mqtt", metavar="HOST[:PORT]", help="also read locators' angles from this broker and publish positions there"
    )
    given = [
        group.add_argument("--mqtt-table", metavar="NAME", help="table that answers; needed where there are several"),
        group.add_argument("--mqtt-topic", help="angles to read (default: silabs/aoa/angle/+/+)"),
        group.add_argument(
            "--mqtt-publish", metavar="TOPIC", help="topic of positions (default: rayfix/position/{target_id})"
        ),
        group.add_argument(
            "--mqtt-output", choices=("native", "3gpp", "omlox"), help="format of positions (default: native)"
        ),
        group.add_argument(
            "--mqtt-station",
            action="append",
            metavar="NAME=STATION",
            help="the station that the broker's topics call NAME; may be given several times",
        ),
        group.add_argument(
            "--mqtt-height",
            type=float,
            nargs=2,
            metavar=("Z", "STDEV"),
            help="known height of all tags in the scene and its standard deviation, m",
        ),
        group.add_argument(
            "--mqtt-confidence",
            type=probability,
            metavar="P",
            help="probability with which the accuracies of positions hold (default: 0.68)",
        ),
        group.add_argument(
            "--mqtt-window", type=float, metavar="S", help="time that a packet waits for more locators (default: 0.5)"
        ),
        group.add_argument(
            "--mqtt-frame", choices=("lcs", "scene", "north"), help="frame of the angles (default: lcs)"
        ),
        group.add_argument(
            "--mqtt-track",
            action="store_true",
            default=None,
            help="follow the broker's tags, with several workers too: one of them reads the broker",
        ),
        group.add_argument(
            "--mqtt-payload-kib", type=at_least_one, metavar="N", help="longest message, KiB (default: 64)"
        ),
        group.add_argument(
            "--mqtt-tls", action="store_true", default=None, help="encrypt; the port is then 8883 unless given"
        ),
        group.add_argument(
            "--mqtt-username",
            metavar="NAME",
            help=f"the password is taken from the environment variable {PASSWORD_VARIABLE}",
        ),
    ]
    command.set_defaults(mqtt_options={action.dest: action.option_strings[0] for action in given})


def mqtt_source(options: argparse.Namespace) -> "MqttSource | None":
    """Return the broker that the options name, or None.

    Raises
    ------
    SettingsError
        When there are options for a broker and none is named.
    MissingExtraError
        When the extra is missing.
    BrokerError, ReportError
        When an option is out of range.
    """
    given = {name: getattr(options, name) for name in options.mqtt_options}
    given = {name: value for name, value in given.items() if value is not None}
    if options.mqtt is None:
        for name in given:
            raise SettingsError(f"{options.mqtt_options[name]} is for an MQTT broker; name it by --mqtt HOST")
        return None
    with needs_extra("mqtt"):
        from rayfix_service.adapters.adapted import known_height, station_map
        from rayfix_service.adapters.mqtt.session import check_settings
        from rayfix_service.adapters.mqtt.settings import MqttSettings, MqttSource, parse_broker
    given = {name.removeprefix("mqtt_"): value for name, value in given.items()}
    table = given.pop("table", None)
    broker = parse_broker(
        options.mqtt,
        tls=given.pop("tls", False),
        username=given.pop("username", None),
        password=os.environ.get(PASSWORD_VARIABLE),
    )
    if "payload_kib" in given:
        given["payload_bytes"] = given.pop("payload_kib") << 10
    settings = MqttSettings(
        stations=station_map(given.pop("station", ())),
        height=known_height(*given.pop("height", (None, None))),
        track=given.pop("track", options.track),
        **given,
    )
    check_settings(settings)
    return MqttSource(broker=broker, settings=settings, table=table)
