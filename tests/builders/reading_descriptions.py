"""Parts of descriptions of reading campaigns."""

#: An accelerometer that is read in milliamperes.
ACCELEROMETER = """[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
output = { unit = "mA", sensitivity = "1.25 mA/g" }
"""


def format_site(radius="", gravity="9.8 m/s^2", latitude="45 deg"):
    """Return the site table, and with a radius also the table of an arm centrifuge."""
    site = f'schema = 1\nsite = {{ gravity = "{gravity}", latitude = "{latitude}" }}\n'
    return site + (f'[centrifuge]\nradius = "{radius}"\n' if radius else "")


def format_rest_run(name, attitude, reading, more=""):
    """Return a run at rest with a single reading."""
    return (
        f'[[runs]]\nname = "{name}"\nmotion = "static"\nattitude = "{attitude}"\n'
        f'reading = "{reading}"\n{more}'
    )


def format_arm_run(
    name, rate, reading, *, side="inward", pendulous="forward", mounting="", more=""
):
    """Return a run on the arm with a single reading; a named mounting has a separate radius."""
    named = f'mounting = "{mounting}"\n' if mounting else ""
    return (
        f'[[runs]]\nname = "{name}"\nmotion = "arm"\nrate = "{rate}"\n{named}'
        f'axes = {{ input = "{side}", pendulous = "{pendulous}" }}\nreading = "{reading}"\n{more}'
    )
