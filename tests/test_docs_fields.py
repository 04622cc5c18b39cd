"""The page of all fields is what the program prints; the schema for editors takes what ships, and no typing error."""

import json
import re
from pathlib import Path

import pytest
import yaml

from qpavoid.config import RobotConfig, ScenarioConfig
from qpavoid.config.fields import page

ROOT = Path(__file__).parent.parent


def test_fields_page_is_what_the_command_prints(cli):
    assert (ROOT / "docs" / "fields.md").read_text() == page() + "\n" == cli("fields").stdout


@pytest.mark.parametrize("root", [ScenarioConfig, RobotConfig])
def test_fields_page_has_a_section_for_every_block(root):
    schema, text = root.model_json_schema(), page()
    headings, sections = text.lower(), text.split("\n## ")
    for name, block in {root.__name__: schema, **schema["$defs"]}.items():
        (section,) = [text for text in sections if text.startswith(f"{name}\n")]
        assert all(f"\n| `{field}` |" in section for field in block.get("properties", {}))
        assert all(f"\n## {link}\n" in headings for link in re.findall(r"\]\(#(\w+)\)", section))


@pytest.mark.parametrize(("kind", "pattern"), [("scenario", "tasks/*.yaml"), ("robot", "robots/*/*.yaml")])
def test_schema_accepts_what_ships_and_no_typing_error(cli, kind, pattern):
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(cli("fields", "--schema", kind).stdout)
    validator = jsonschema.validators.validator_for(schema)(schema)
    files = sorted(ROOT.glob(pattern))
    assert len(files) > 4
    for path in files:
        fields = yaml.safe_load(path.read_text())
        validator.validate(fields)
        with pytest.raises(jsonschema.ValidationError):
            validator.validate({**fields, "avoidence": {}})
