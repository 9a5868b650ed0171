"""Kind of option that is a local path or a URL of an object storage, of which ``Path`` would make s3:/bucket."""

from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from mereo.io.object_storage import Place, place_of


class _InOptionsFile:
    """How pydantic reads what a file of options has for such an option."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(place_of, core_schema.str_schema())


PlaceOption = Annotated[
    Place,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: place_of(words[0]),
        is_instance=lambda value: isinstance(value, Place),
        str_from_instance=lambda place: [str(place)],
    ),
    _InOptionsFile(),
]
