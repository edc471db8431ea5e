"""std_msgs/String that carries JSON with a published schema: atlas/info and shift_estimate.

The full schemas are published as ``atlas/info.schema.json`` and ``inverse/shift_estimate.schema.json``. The models below
name what a reader of the graph relies on; they refuse another schema name and keep all further keys.
"""

from __future__ import annotations

from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from brainshift_ros.errors import InputError
from brainshift_ros.graph import Topic
from brainshift_ros.wire.plain import Plain, plain_stamp


class AtlasInfo(BaseModel):
    """What `atlas/info` says of the atlas in use; the atlas itself is read from `path`."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    schema_name: Literal["brainshift/atlas-info/1"] = Field(alias="schema")
    path: str = Field(min_length=1, description="absolute path of the atlas file, on the machine of the graph")
    atlas_id: str = Field(min_length=1, description="the atlas's hash; a reader of `path` must find the same")
    patient_id: str = Field(min_length=1, description="hash of the patient model that the atlas was built for")


class TextStamp(BaseModel):
    """A time as headers carry it, since the epoch."""

    sec: int
    nanosec: int

    @staticmethod
    def of(stamp_ns: int) -> TextStamp:
        """Return the stamp of nanoseconds since the epoch."""
        return TextStamp(**plain_stamp(stamp_ns))


class PublishedField(BaseModel):
    """Which `displacement_field` is latched, so that a late joiner does not take an older one for the newest."""

    stamp: TextStamp = Field(description="that of its header: when its points were measured")
    points: str = Field(description="hash of its points")
    atlas: str = Field(description="id of its atlas")
    current: bool = Field(description="whether it was made from the same inputs as this estimate")


class ShiftEstimateText(BaseModel):
    """What `shift_estimate` always says, of a field that is published, is refused, or could not be computed at all."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    schema_name: Literal["brainshift/shift-estimate/2"] = Field(alias="schema")
    valid: bool = Field(description="whether the residual and the other gates passed")
    reasons: list[str] = Field(description="why it is not valid; empty if it is")
    ids: dict[str, str] = Field(description="the inputs; empty where there are none, or no estimate")
    stamp: TextStamp = Field(description="when the points of this estimate were measured")
    ages_s: dict[str, float] = Field(description="age of each input when the estimate was published, seconds")
    displacement_field: PublishedField | None = Field(description="the field that is latched now; null if there is none")


Text = TypeVar("Text", bound=BaseModel)


def decode_text(model: type[Text], message: Any, topic: Topic) -> Text:
    """Content of a String message as `model`.

    Raises
    ------
    InputError
        Not JSON, another schema, or a key missing or of the wrong type; every fault is named.
    """
    try:
        return model.model_validate_json(message.data)
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, e['loc'])) or 'text'}: {e['msg']}" for e in error.errors())
        raise InputError(topic.name, faults, f"send JSON of the schema that {model.__name__} describes") from error


def encode_text(content: BaseModel) -> Plain:
    """Plain String of a model; JSON has no numbers that are not finite, they become null."""
    return {"data": content.model_dump_json(by_alias=True)}
