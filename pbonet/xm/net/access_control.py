"""Permissions on the network, as enforced by zenoh's access control.

zenoh checks a message by the link on which it comes or goes, so every agent filters its
own links: what an observer sends is dropped by the agent it is connected to, whichever
RTPU it is meant for. Agents trust each other, and processes of the same user that
connect to the agent's Unix socket.
"""

from __future__ import annotations

from typing import Any

from . import key_expressions
from .credentials import Role

_EVERYTHING = [
    *("put", "delete", "declare_subscriber"),
    *("query", "reply", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
]
LOCAL = "unixsock-stream"
"""Protocol of processes on the agent's machine; only the user can open the socket."""


def rules() -> dict[str, Any]:
    """Return zenoh's `access_control` for an agent with keys."""
    asked = [key_expressions.rtpu("*", "*", "status")]
    seen = [
        key_expressions.rtpu("*", "*", "event"),
        key_expressions.rtpu("*", "*", "alive"),
        key_expressions.masters("*", "*"),
    ]
    looking = (
        "declare_subscriber",
        "liveliness_query",
        "declare_liveliness_subscriber",
    )
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            _rule("all", "both", _EVERYTHING, ["**"]),
            _rule("ask", "ingress", ["query"], asked),
            _rule("answer", "egress", ["reply", "declare_queryable"], asked),
            _rule("look", "ingress", looking, seen),
            _rule("show", "egress", ["put", "liveliness_token"], seen),
        ],
        "subjects": [
            {
                "id": "trusted",
                "cert_common_names": [Role.AGENT.common_name, Role.MASTER.common_name],
            },
            {"id": "local", "link_protocols": [LOCAL]},
            {"id": "observers", "cert_common_names": [Role.OBSERVER.common_name]},
        ],
        "policies": [
            {"rules": ["all"], "subjects": ["trusted", "local"]},
            {
                "rules": ["ask", "answer", "look", "show"],
                "subjects": ["observers"],
            },
        ],
    }


def _rule(
    name: str, flow: str, messages: list[str] | tuple[str, ...], on: list[str]
) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": ["ingress", "egress"] if flow == "both" else [flow],
        "messages": list(messages),
        "key_exprs": on,
    }
