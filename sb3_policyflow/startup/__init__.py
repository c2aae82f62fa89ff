"""What the wheel puts beside this package, so that Python runs it at its start: docs/zoo.md."""
