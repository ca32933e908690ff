"""The README's lines for estimates, as printed: curl, tritonclient, a live session."""

import pathlib
import re
import subprocess
import sys
import tempfile

import numpy
import pyarrow.compute
import pyarrow.parquet
from test_triton import Service, trained_model

SECTION = "## Estimates for the tools you have"


def blocks(language):
    text = pathlib.Path(__file__).parents[2].joinpath("README.md").read_text()
    section = text.split(SECTION)[1].split("\n## ")[0]
    found = re.findall(rf"```{language}\n(.*?)```", section, re.DOTALL)
    assert found, f"no {language} in {SECTION}"
    return found


def main():
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        service = Service(folder)
        try:
            model = trained_model(service)
            address = service.url.removeprefix("http://")

            def here(text):
                return text.replace("localhost:8080", address).replace("MODEL", model)

            # A recording as somebody might have it: a run of the data set.
            dataset = service.ask("/v1/datasets")["datasets"][0]["dataset_id"]
            path = service.ask(f"/v1/datasets/{dataset}")["files"]
            path = next(file["path"] for file in path if file["path"].startswith("data/"))
            subprocess.run(["curl", "-sf", "-o", folder / "data.parquet", f"{service.url}/v1/datasets/{dataset}/files/{path}"], check=True)
            table = pyarrow.parquet.read_table(folder / "data.parquet")
            recording = table.filter(pyarrow.compute.equal(table["run_id"], table["run_id"][0]))
            pyarrow.parquet.write_table(recording, folder / "recorded.parquet")

            for block in blocks("sh"):
                subprocess.run(["bash", "-e", "-c", here(block).replace("curl ", "curl -sSf ")], cwd=folder, check=True)
            estimates = pyarrow.parquet.read_table(folder / "estimates.parquet")
            metadata = service.ask("/v2/models/boom@stable")
            target = metadata["parameters"]["targets"][0]
            column = next(name for name in estimates.column_names if name.startswith(target))

            # What the second and the third example start from.
            inputs = metadata["parameters"]["inputs"]
            samples = numpy.stack([recording[name].to_numpy() for name in inputs], axis=1).astype(numpy.float64)
            steps = metadata["inputs"][0]["shape"][1]
            x = numpy.stack([samples[k:k + steps] for k in range(5)])
            answers = []
            names = {"x": x, "samples": [dict(zip(inputs, row)) for row in samples.tolist()], "print": lambda *values: answers.append(values)}
            for block in blocks("python"):
                exec(here(block), names)
            from_file = numpy.array([value for value in estimates[column].to_pylist() if value is not None])
            size = numpy.ptp(from_file)
            assert numpy.abs(names["y"][:, 0] - from_file[:5]).max() <= 1e-6 * size
            live = [values[0] for values in answers if values[0] is not None]
            assert len(live) == len(samples) - steps + 1, (len(live), len(samples), steps)
            assert numpy.abs(numpy.array([estimate[target] for estimate in live]) - from_file).max() <= 1e-6 * size
        finally:
            service.kill()
    print("the README's lines: all as printed")


if __name__ == "__main__":
    sys.exit(main())
