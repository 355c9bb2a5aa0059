"""The check of a single run."""

RUN = {"name": "three", "run": "fast"}


def test_run_check_returns_verdict(page, folder):
    body = page.get("/api/check", params=RUN).json()
    assert "fast" in body["html"]
    assert body["command"].startswith("counterspin check ")
    (folder / "three" / "fast.csv").write_text("time_s,angle_rad,east_m,north_m\n1,2,3,4\n")
    assert page.get("/api/check", params=RUN).json()["good"] is False
    assert page.get("/api/check", params=RUN | {"run": "none"}).status_code == 404
