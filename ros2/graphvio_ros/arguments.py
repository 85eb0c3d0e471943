"""The arguments by which ROS 2 starts a node: its name, its namespace and its parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from graphvio.errors import ConfigError
from graphvio.ros2.parameters import Value, flatten


@dataclass
class NodeArguments:
    """What follows ``--ros-args``."""

    name: str = "graphvio"
    namespace: str = "/"
    parameters: dict[str, Value] = field(default_factory=dict)

    @property
    def full_name(self) -> str:
        """Name with the namespace, such as ``/robot/graphvio``."""
        return f"/{self.namespace.strip('/')}/{self.name}".replace("//", "/")


def parse(arguments: Sequence[str]) -> NodeArguments:
    """Parse the arguments of a node; later parameters replace earlier ones.

    Args:
        arguments: such as ``--ros-args -r __node:=graphvio --params-file FILE -p source:=simulator``.

    Raises:
        ConfigError: if one cannot be understood.
    """
    parsed, files, given = NodeArguments(), [], []
    left = iter(arguments)
    for argument in left:
        if argument in ("--ros-args", "--"):
            continue
        if argument in ("--disable-stdout-logs", "--disable-rosout-logs", "--disable-external-lib-logs"):
            continue
        value = next(left, None)
        if value is None:
            raise ConfigError(f"{argument}: has no value; give arguments of ROS 2, such as -p source:=simulator")
        if argument in ("-r", "--remap"):
            what, _, new = value.partition(":=")
            if what == "__node":
                parsed.name = new
            elif what == "__ns":
                parsed.namespace = new
            else:
                raise ConfigError(f"{value}: topics cannot be renamed; give the node another name or namespace")
        elif argument == "--params-file":
            files.append(Path(value))
        elif argument in ("-p", "--param"):
            given.append(value)
        elif argument not in ("--log-level", "--log-config-file", "-e", "--enclave"):
            raise ConfigError(f"{argument}: is no argument of a ROS 2 node; see docs/how-to/sensors/ros2.md")
    for path in files:
        parsed.parameters |= _from_file(path, parsed)
    for each in given:
        name, _, text = each.partition(":=")
        parsed.parameters[name] = yaml.safe_load(text)
    return parsed


def _from_file(path: Path, node: NodeArguments) -> dict[str, Value]:
    """Return the parameters that a file has for this node."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: cannot be read ({' '.join(str(error).split())}); give a YAML file") from None
    parameters: dict[str, Value] = {}
    for wanted in ("/**", node.name, node.full_name):
        of_node: Any = content.get(wanted) if isinstance(content, Mapping) else None
        values = of_node.get("ros__parameters") if isinstance(of_node, Mapping) else None
        if isinstance(values, Mapping):
            parameters |= flatten(values)
    return parameters
