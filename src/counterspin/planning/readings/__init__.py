"""Plans of readings, at rest, on an arm or on a turntable.

- `stations`: where readings may be taken, from ``PLAN.toml``
- `counts`: how often to take each
- `reading_plan`: the plan, and the order of its readings
"""
