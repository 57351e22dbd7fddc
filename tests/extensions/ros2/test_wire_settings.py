"""Communication stays on this machine unless configured otherwise."""

import pytest

from finssim.extensions.ros2 import Ros2Error
from finssim.extensions.ros2.wire import LOOPBACK, wire_settings


def test_without_a_word_it_is_the_loopback():
    """Defaults are domain 0, this machine only, Jazzy."""
    settings = wire_settings({})
    assert (settings.domain, settings.xml, settings.distro.name) == (0, LOOPBACK, "jazzy")
    assert "name='lo'" in LOOPBACK and "127.0.0.1" in LOOPBACK


def test_the_domain_alone_does_not_open_the_network():
    """ROS_DOMAIN_ID chooses the domain and nothing more."""
    settings = wire_settings({"ROS_DOMAIN_ID": "42"})
    assert (settings.domain, settings.xml) == (42, LOOPBACK)


@pytest.mark.parametrize(
    "environ",
    [
        {"ROS_LOCALHOST_ONLY": "0"},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"},
        {"CYCLONEDDS_URI": "file:///mine.xml", "ROS_LOCALHOST_ONLY": "1"},
    ],
)
def test_who_asks_for_the_network_gets_it(environ):
    """Cyclone's own configuration then applies."""
    assert wire_settings(environ).xml is None


@pytest.mark.parametrize(
    "environ", [{"ROS_LOCALHOST_ONLY": "1"}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}]
)
def test_who_asks_for_this_machine_gets_it(environ):
    """Each setting restricts communication to this machine."""
    assert wire_settings(environ).xml == LOOPBACK


@pytest.mark.parametrize(
    "environ",
    [
        {"ROS_DOMAIN_ID": "233"},
        {"ROS_DOMAIN_ID": "x"},
        {"ROS_LOCALHOST_ONLY": "yes"},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "FAR"},
        {"ROS_DISTRO": "foxy"},
    ],
)
def test_nonsense_is_refused(environ):
    """The message names the variable."""
    with pytest.raises(Ros2Error, match=next(iter(environ))):
        wire_settings(environ)


def test_releases_differ_as_they_do():
    """Humble has long identifiers and no hashes."""
    humble, jazzy = (wire_settings({"ROS_DISTRO": d}).distro for d in ("humble", "jazzy"))
    assert (humble.gid_length, humble.type_hashes, jazzy.gid_length, jazzy.type_hashes) == (
        24,
        False,
        16,
        True,
    )
