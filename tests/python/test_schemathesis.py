"""schemathesis over the published document, against a running service without workers."""

import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

BINARY = os.environ.get("HYDROFLEX_BIN", "target/release/hydroflex")
# Enough to meet every field of every body a few times; the whole run stays within two minutes.
EXAMPLES = 15


def main():
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        with open(folder / "log", "w") as log:
            service = subprocess.Popen(
                [BINARY, "serve", "--listen", "127.0.0.1:0", "--data", folder / "data", "--workers", "0", "--json"],
                stdout=log, stderr=log,
            )
        try:
            url = None
            while url is None:
                assert service.poll() is None, (folder / "log").read_text()
                lines = [line for line in (folder / "log").read_text().splitlines() if '"url"' in line]
                url = json.loads(lines[-1])["fields"]["url"] if lines else None
                time.sleep(0.05)
            result = subprocess.run(
                [
                    pathlib.Path(sys.executable).parent / "schemathesis", "run", url + "/openapi.json",
                    "--checks", "not_a_server_error,content_type_conformance,response_schema_conformance",
                    "--max-examples", str(EXAMPLES), "--seed", "1", "--workers", "1", "--request-timeout", "20",
                    # A session is no request and answer, and events end with their job.
                    "--exclude-path-regex", "/stream$|/events$",
                    "--phases", "examples,coverage,fuzzing", "--generation-database", "none", "--suppress-health-check", "all",
                ],
                cwd=folder,
            )
            assert service.poll() is None, "the service ended"
            return result.returncode
        finally:
            service.kill()
            service.wait()


if __name__ == "__main__":
    sys.exit(main())
