"""What a node knows of the other nodes on the wire."""

from __future__ import annotations

from typing import Any

from finssim.ros2.shim.names import expanded

__all__ = ["NodeGraph"]


class NodeGraph:
    """The part of `Node` that looks at the graph."""

    context: Any
    _name: str
    _namespace: str

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Every node on the wire, this one among them."""
        return sorted((node.name, node.namespace) for node in self.context.participant.nodes())

    def get_node_names(self) -> list[str]:
        """Names of every node on the wire."""
        return [name for name, _ in self.get_node_names_and_namespaces()]

    def count_publishers(self, topic: str) -> int:
        """Publishers known on a topic."""
        return self._count(topic, "publications")

    def count_subscribers(self, topic: str) -> int:
        """Subscriptions known on a topic."""
        return self._count(topic, "subscriptions")

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        """Every topic on the wire with its types."""
        found: dict[str, set[str]] = {}
        for kind in ("publications", "subscriptions"):
            for topic, name in self.context.participant.endpoints(kind):
                if topic.startswith("rt/"):
                    found.setdefault(topic[2:], set()).add(name)
        return sorted((topic, sorted(names)) for topic, names in found.items())

    def _count(self, topic: str, kind: str) -> int:
        full = f"rt{expanded(topic, self._name, self._namespace)}"
        return sum(found == full for found, _ in self.context.participant.endpoints(kind))
