"""The page of all fields is what the program prints; the schema for editors takes what ships, and no typing error."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from qpavoid.config import RobotConfig, ScenarioConfig
from qpavoid.config.fields import page

ROOT = Path(__file__).parent.parent


def printed(*options):
    command = [sys.executable, "-m", "qpavoid", "fields", *options]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_the_page_is_what_the_command_prints():
    assert (ROOT / "docs" / "fields.md").read_text() == page() + "\n" == printed()


@pytest.mark.parametrize("root", [ScenarioConfig, RobotConfig])
def test_every_block_has_a_section_with_all_of_its_fields(root):
    schema, sections = root.model_json_schema(), page().split("\n## ")
    for name, block in {root.__name__: schema, **schema["$defs"]}.items():
        (section,) = [text for text in sections if text.startswith(f"{name}\n")]
        assert all(f"\n| `{field}` |" in section for field in block.get("properties", {}))
        assert all(f"\n## {link}\n" in page().lower() for link in re.findall(r"\]\(#(\w+)\)", section))


@pytest.mark.parametrize(("kind", "pattern"), [("scenario", "tasks/*.yaml"), ("robot", "robots/*/*.yaml")])
def test_an_editor_with_the_schema_takes_what_ships(kind, pattern):
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(printed("--schema", kind))
    files = sorted(ROOT.glob(pattern))
    assert len(files) > 4
    for path in files:
        fields = yaml.safe_load(path.read_text())
        jsonschema.validate(fields, schema)
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**fields, "avoidence": {}}, schema)
