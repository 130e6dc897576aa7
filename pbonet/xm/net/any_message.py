"""The type of every request that an agent takes."""

from __future__ import annotations

from typing import TypeAlias

from .file_messages import AnyFileRequest
from .messages import AnyRequest
from .resource_messages import AnyXmRequest

AnyMessage: TypeAlias = AnyRequest | AnyXmRequest | AnyFileRequest
