-- A straight line over days through each pack's ln(capacity), ln(R_s) and margin, by weighted least squares; years from today.
-- Needs: days.
CREATE TEMP TABLE fits AS
WITH decayed AS (
    SELECT *, exp(-through / $aged_soc) ^ 2 AS kept FROM days
),
-- What a day alone told of the capacity. The filter's estimates of two days are nearly the same estimate: information
-- at the end of the day, less what was left of that at its begin, is independent from day to day.
began AS (
    SELECT
        pack, day, ln_capacity, capacity_variance,
        coalesce(lag(ln_capacity) OVER w * sqrt(kept), 0) AS ln_begin,
        coalesce(lag(capacity_variance) OVER w * kept + (1 - kept) * capacity_first_variance, capacity_first_variance)
            AS variance_begin
    FROM decayed
    WHERE capacity_variance > 0 AND capacity_first_variance > 0
    WINDOW w AS (PARTITION BY pack ORDER BY day)
),
-- w: weight of the point, one over its variance
points AS (
    SELECT
        pack, day, 'capacity' AS quantity,
        1 / capacity_variance - 1 / variance_begin AS w,
        (ln_capacity / capacity_variance - ln_begin / variance_begin)
            / (1 / capacity_variance - 1 / variance_begin) AS value
    FROM began
    WHERE capacity_variance < 0.9999 * variance_begin  -- what is less is rounding
    UNION ALL
    SELECT pack, day, 'r_s', 1 / r_s_variance, ln_r_s FROM days WHERE r_s_variance > 0
    UNION ALL
    SELECT pack, day, 'margin', 1, margin FROM days WHERE margin IS NOT NULL
),
stepped AS (
    SELECT
        *,
        (day - $today) / 365.25 AS t,
        (day - lag(day) OVER w) / 365.25 AS dt,
        value - lag(value) OVER w AS dv
    FROM points
    WINDOW w AS (PARTITION BY pack, quantity ORDER BY day)
),
sums AS (
    SELECT
        pack, quantity, count(*) AS n, min(day) AS first_day, max(day) AS last_day,
        sum(w) AS s, sum(w * t) / sum(w) AS middle, sum(w * value) / sum(w) AS mean,
        sum(w * t * t) - sum(w * t) ^ 2 / sum(w) AS tt,
        sum(w * t * value) - sum(w * t) * sum(w * value) / sum(w) AS tv,
        sum(w * value * value) - sum(w * value) ^ 2 / sum(w) AS vv,
        sum(w * dv * dv) AS dvdv, sum(w * dv * dt) AS dvdt, sum(w * dt * dt) AS dtdt
    FROM stepped
    GROUP BY pack, quantity
    HAVING count(*) >= $least_days
),
lines AS (
    SELECT
        *,
        tv / tt AS slope,
        greatest(vv - tv ^ 2 / tt, 1e-12 * s) AS rest,
        greatest(dvdv - 2 * (tv / tt) * dvdt + (tv / tt) ^ 2 * dtdt, 0) AS rest_of_steps
    FROM sums
),
-- By how much the points lie further from the line than their weights say, and how alike those of days in a row are
-- (Durbin and Watson; Cochrane and Orcutt): of capacities, whose errors are known, only the first, if it is more.
widened AS (
    SELECT
        *,
        least(greatest(1 - rest_of_steps / rest / 2 + 2 / n, 0), 0.9) AS alike,
        CASE quantity WHEN 'capacity' THEN greatest(rest / (n - 2), 1)
            ELSE rest / (n - 2) * (1 + alike) / (1 - alike) END AS factor
    FROM lines
)
SELECT
    pack, quantity, n, first_day, last_day, middle, mean, slope,
    sqrt(factor / s) AS mean_std,
    sqrt(factor / tt) AS slope_std,
    mean - slope * middle AS today,
    sqrt(factor / s + factor / tt * middle ^ 2) AS today_std,
    -- of Student's t, n - 2 degrees of freedom: what 1.96 is of a normal distribution (Cornish and Fisher)
    1.96 + 2.37 / (n - 2) + 2.82 / (n - 2) ^ 2 AS reach
FROM widened
