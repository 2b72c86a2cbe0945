import pytest

from experiments import patrol
from rp_jax.cli import experiment


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--x", "inf"], "x is inf; it must be a finite number"),
        (["--no-shield"], "shield is False; it must be one of True"),
        (["--learning-penalty", "5"], "learning_penalty is 5.0; it must be"),
        (["--learning-penalty-from", "5"], "learning_penalty_from is 5.0; it must be one of None"),
    ],
)
def test_comparisons_of_shields_set_the_penalty_themselves(words, message, tmp_path, capsys):
    argv = [*words, "--out", str(tmp_path / "new")]
    with pytest.raises(SystemExit, match="2"):
        experiment.run(patrol.EXPERIMENT, argv)
    assert message in " ".join(capsys.readouterr().out.split())
    assert not (tmp_path / "new").exists()
