-- Daily values of each pack's ln(capacity), ln(R_s) and margin, each with its weight, one over its variance. Needs: days.
CREATE TEMP TABLE points AS
WITH decayed AS (
    SELECT *, exp(-through / $aged_soc) ^ 2 AS remaining FROM days
),
-- Information on the capacity from each single day. The filter's estimates of consecutive days are strongly correlated.
-- The information at the end of a day, minus the remainder of the information at its beginning, is independent of that of
-- other days.
began AS (
    SELECT
        pack, day, ln_capacity, capacity_variance,
        coalesce(lag(ln_capacity) OVER w * sqrt(remaining), 0) AS ln_begin,
        coalesce(lag(capacity_variance) OVER w * remaining + (1 - remaining) * capacity_first_variance, capacity_first_variance)
            AS variance_begin
    FROM decayed
    WHERE capacity_variance > 0 AND capacity_first_variance > 0
    WINDOW w AS (PARTITION BY pack ORDER BY day)
)
SELECT
    pack, day, 'capacity' AS quantity,
    1 / capacity_variance - 1 / variance_begin AS w,
    (ln_capacity / capacity_variance - ln_begin / variance_begin)
        / (1 / capacity_variance - 1 / variance_begin) AS value
FROM began
WHERE capacity_variance < 0.9999 * variance_begin  -- a smaller difference is a rounding error
UNION ALL
SELECT pack, day, 'r_s', 1 / r_s_variance, ln_r_s FROM days WHERE r_s_variance > 0
UNION ALL
SELECT pack, day, 'margin', 1, margin FROM days WHERE margin IS NOT NULL
