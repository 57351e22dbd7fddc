"""The table of topics, the page that shows it, and the record agree."""

from pathlib import Path

import pytest

from finssim.extensions.ros2.codec import codec_of
from finssim.extensions.ros2.topics import FRAMES, OWN_TOPICS, QUALITIES, SERVICES, TOPICS

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "reference" / "ros2_topics.md").read_text()


def row(*cells):
    """Return a row of a table on the page."""
    return "| " + " | ".join(cells) + " |"


ALL = [*TOPICS.values(), *(topic for topics in OWN_TOPICS.values() for topic in topics.values())]


@pytest.mark.parametrize("topic", ALL, ids=lambda topic: topic.name)
def test_each_topic_is_known_and_on_the_page(topic):
    """Its type exists for Humble and Jazzy, its quality and frame are explained, and the page contains its
    row."""
    for distro in ("humble", "jazzy"):
        assert codec_of(distro).message(topic.type)
    assert topic.quality in QUALITIES and (not topic.frame or topic.frame in FRAMES)
    shown = row(f"`{topic.name}`", topic.type, topic.frame or "–", topic.quality, topic.sender, topic.meaning)
    assert shown in PAGE


def test_services_qualities_and_frames_are_on_the_page():
    """The other tables of the page are complete."""
    lines = [row(f"`{s.name}`", s.type, s.server, s.meaning) for s in SERVICES.values()]
    lines += [row(*pair) for pair in QUALITIES.items()] + [
        row(f"`{name}`", text) for name, text in FRAMES.items()
    ]
    assert not [line for line in lines if line not in PAGE]


def test_topics_stand_below_the_vehicle():
    """Topics with a leading slash are absolute."""
    assert TOPICS["odometry"].under("rov") == "/rov/odom" and TOPICS["clock"].under("rov") == "/clock"


def test_each_quality_has_its_profile():
    """Profiles agree with the text of the page."""
    from finssim.extensions.ros2.backend import activate
    from finssim.extensions.ros2.topics import quality_profile

    activate(announce=False)
    for quality, words in QUALITIES.items():
        profile = quality_profile(quality)
        shown = [profile.reliability.name, profile.durability.name, f"depth {profile.depth}"]
        assert ", ".join(shown).lower().replace("_", " ") == words
