"""Permissions on the network, as enforced by zenoh's access control.

zenoh checks a message by the link on which it comes or goes, so every agent filters its
own links: what a link's other side may not send is dropped by the agent at this end,
whichever RTPU it is meant for. The other side is a process, but the message may come
from further behind it. So the keys of an agent at the other side say whether commands
may come through it: those of a gateway allow it, others do not. Processes of the same
user that connect to the agent's Unix socket may do everything.

zenoh compares the common name of a certificate as a whole, and knows no patterns.
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
_NO_REQUESTS = [one for one in _EVERYTHING if one not in {"query", "declare_queryable"}]
LOCAL = "unixsock-stream"
"""Protocol of processes on the agent's machine; only the user can open the socket."""


def rules() -> dict[str, Any]:
    """Return zenoh's `access_control` for an agent with keys."""
    asked = [key_expressions.rtpu("*", "*", "status")]
    # What agents ask each other. Queries are named one by one, not commands excluded:
    # a query with wildcards would reach a command's key without being part of it.
    asked_by_agents = [
        *asked,
        key_expressions.rtpu("*", "*", "mail"),
        key_expressions.rtpu("*", "*", "dials"),
        key_expressions.svar("*", "*", "*"),
    ]
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
            _rule("take part", "both", _NO_REQUESTS, ["**"]),
            _rule("be asked", "egress", ["query"], ["**"]),
            _rule("serve", "ingress", ["declare_queryable"], ["**"]),
            _rule("ask as agent", "ingress", ["query"], asked_by_agents),
            _rule("answer agents", "egress", ["declare_queryable"], asked_by_agents),
            _rule("ask", "ingress", ["query"], asked),
            _rule("answer", "egress", ["reply", "declare_queryable"], asked),
            _rule("look", "ingress", looking, seen),
            _rule("show", "egress", ["put", "liveliness_token"], seen),
        ],
        "subjects": [
            _subject("trusted", Role.GATEWAY, Role.MASTER),
            {"id": "local", "link_protocols": [LOCAL]},
            _subject("agents", Role.AGENT),
            _subject("observers", Role.OBSERVER),
        ],
        "policies": [
            {"rules": ["all"], "subjects": ["trusted", "local"]},
            {
                "rules": [
                    *("take part", "be asked", "serve"),
                    *("ask as agent", "answer agents"),
                ],
                "subjects": ["agents"],
            },
            {
                "rules": ["ask", "answer", "look", "show"],
                "subjects": ["observers"],
            },
        ],
    }


def ros2_rules(domain: int) -> dict[str, Any]:
    """Return zenoh's `access_control` of a session with nodes of ROS 2.

    They have their domain and their tokens, and no key of pbonet, whatever is connected
    to them.
    """
    keys = [f"{domain}/**", f"{domain}/**/@adv/**", f"@ros2_lv/{domain}/**"]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [_rule("ros 2", "both", _EVERYTHING, keys)],
        "subjects": [{"id": "everybody"}],
        "policies": [{"rules": ["ros 2"], "subjects": ["everybody"]}],
    }


def _subject(name: str, *roles: Role) -> dict[str, Any]:
    return {"id": name, "cert_common_names": [role.common_name for role in roles]}


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
