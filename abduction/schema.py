"""Names and versions of what is written down, checked when it is read back."""

from collections.abc import Mapping

from worldstate.errors import InputFileError, SchemaVersionError


def check_schema(data: object, schema: str, version: str, source: object) -> Mapping[str, object]:
    """Return `data` as a mapping if it says that it is of this schema and major version.

    Parameters
    ----------
    data : object
        What was read, for example from JSON.
    schema, version : str
        The name and the semantic version that the caller writes itself.
    source : object
        Where `data` comes from; errors begin with it.

    Raises
    ------
    InputFileError
        If it is no mapping or of another schema.
    SchemaVersionError
        If its major version is another one.

    Examples
    --------
    >>> sorted(check_schema({"schema": "a.B", "version": "1.7.0"}, "a.B", "1.0.0", "b.json"))
    ['schema', 'version']
    """
    if not isinstance(data, Mapping):
        raise InputFileError(source, f"expected a JSON object of schema {schema}, got {type(data).__name__}")
    if data.get("schema") != schema:
        raise InputFileError(source, f"expected schema {schema}, got {_brief(data.get('schema'))}")
    found = data.get("version")
    if not isinstance(found, str) or found.count(".") != 2:
        raise InputFileError(source, f"expected a version such as {version}, got {_brief(found)}")
    if found.split(".")[0] != version.split(".")[0]:
        raise SchemaVersionError(source, f"expected {schema} {version.split('.')[0]}.x, got {_brief(found)}")
    return data


def _brief(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
