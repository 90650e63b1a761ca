"""The columns of ``bench lines`` and what they mean."""

from sl3d_slam.bench.tables import Column

COLUMNS = (
    Column("drives", "drive"),
    Column("kind", "data", main=False),
    Column("distance", "apart"),
    Column("method", "method"),
    Column("num_pairs", "pairs", "{:d}", main=False),
    Column("found_per_scan", "lines/scan", "{:.0f}"),
    Column("used_per_scan", "compared", "{:.0f}", main=False),
    Column("seen_per_pair", "seen/scan", "{:.1f}", main=False),
    Column("repeat", "found again %"),
    Column("repeat_gain", "against the first", main=False),
    Column("first", "ranked first %"),
    Column("chance_first_percent", "chance", "{:.0f}", main=False),
    Column("top", "in top 5 %"),
    Column("chance_top_percent", "chance", "{:.0f}"),
    Column("registered", "registered %"),
    Column("registered_alone", "by lines alone %"),
    Column("status", "status"),
)
TRUE_COLUMNS = (
    Column("drives", "drive"),
    Column("method", "method"),
    Column("num_scans", "scans", "{:d}", main=False),
    Column("found_per_scan", "lines/scan", "{:.0f}"),
    Column("used_per_scan", "compared", "{:.0f}"),
    Column("visible_per_scan", "true lines in view", "{:.0f}"),
    Column("precision", "precision %"),
    Column("recall", "recall %"),
    Column("recall_standing", "of standing ones %"),
    Column("precision_all", "precision, all lines %"),
    Column("recall_all", "recall, all lines %"),
    Column("false_on", "false ones on"),
    Column("status", "status"),
)
NOTES = (
    "All figures but lines/scan and registration compare equally many lines: in each scan as many "
    "of every method, best scores first, as the method with the fewest found there.",
    "Found again: of the lines in the other scan's view, those whose partner there lies within "
    "0.3 m and 5 deg, nearest to each other both ways; distances are taken in the middle of the "
    "common stretch, or of a gap of at most 1 m. In view: 1 m of the line (or four fifths) within "
    "40 m, inside the field of view and not behind a nearer return; nothing need be there, so a "
    "line that does not exist counts against its method.",
    "Ranked: where the descriptor puts the true partner among all lines of the other scan, ties "
    "counting against it; chance is what a descriptor that knows nothing gets.",
    "Registered: within 2 m and 5 deg, no first guess, sensors turned about z at random; all lines "
    "of each method, the same matching and clouds; the first pairs of each distance only.",
    "After the sign: standard deviation over 1,000 drawings of as many pairs with replacement; "
    "pairs of one drive share scans and streets, so another drive differs by more. For "
    "registration: how well so many answers tell the rate. 'Against the first': the difference in "
    "lines found again on the same pairs.",
    "Relative poses of real scans are refined by GICP from the poses given or KISS-ICP's.",
)
TRUE_NOTES = (
    "In view: at least 5 returns of the line within 40 m, over at least 0.8 m of it. Precision: "
    "share of lines within 0.3 m and 5 deg of any true line; recall: share of those in view found. "
    "Compared lines as in the first table; 'all lines' takes every method's own number.",
    "False ones on: what most returns within 0.4 m of the wrong lines lie on.",
)
