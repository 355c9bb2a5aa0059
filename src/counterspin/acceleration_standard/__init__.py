"""Centrifuge as a standard of acceleration (IEEE Std 836, Annex B).

- `model`: the applied acceleration, its sensitivities, and its distribution by Monte Carlo
- `budget`: the uncertainty budget of a campaign's centrifuge by acceleration level
- `result`: the budget and its JSON
- `page`: its report
- `certificate`: the certificate of the centrifuge
"""
