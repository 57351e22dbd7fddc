"""Reader of untrusted XML files of bounded size."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from finssim.core.budget import NODES, read_bytes

__all__ = ["parse_xml", "read_xml"]

LARGEST = 32 << 20
"""Largest size of an XML file [bytes]."""


def read_xml(path: Path, refuse: type[Exception]) -> Element:
    """Return the root element of a file.

    Args:
        path: The file.
        refuse: Class of the error, constructed with one sentence.

    Raises:
        refuse: The file is not XML, is too large, or has a DOCTYPE.
    """
    return parse_xml(read_bytes(path, refuse, limit=LARGEST), path, refuse)


def parse_xml(data: bytes, path: Path, refuse: type[Exception]) -> Element:
    """Return the root element of the content of a file; see `read_xml`."""

    def refuse_doctype(*_: object) -> None:
        raise refuse(f"{path}: has a DOCTYPE, which may name other files: remove it")

    # Like other readers of these files, accept a prefix such as gz: without a declared namespace.
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse_doctype
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(data, True)
        root = builder.close()
    except (expat.ExpatError, AssertionError, ValueError, LookupError) as error:
        raise refuse(f"{path}: cannot be read as XML: {error}") from None
    if sum(1 for _ in root.iter()) > NODES:
        raise refuse(f"{path}: has more than {NODES} elements: make it smaller")
    return root
