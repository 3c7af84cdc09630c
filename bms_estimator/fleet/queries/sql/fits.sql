-- Straight line through the daily values of each pack's ln(capacity), ln(R_s) and margin, by weighted least squares.
-- Times are in years from today. Needs: points.
CREATE TEMP TABLE fits AS
WITH
-- t: years from today; dt, dv: change of time and value since the previous point
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
    HAVING count(*) >= $min_days
),
lines AS (
    SELECT
        *,
        tv / tt AS slope,
        greatest(vv - tv ^ 2 / tt, 1e-12 * s) AS residual,
        greatest(dvdv - 2 * (tv / tt) * dvdt + (tv / tt) ^ 2 * dtdt, 0) AS residual_of_steps
    FROM sums
),
-- Ratio of the observed to the expected variance of the points about the line, and autocorrelation of consecutive points
-- (Durbin and Watson; Cochrane and Orcutt). The errors of capacities are known and independent: for them, only a ratio
-- above 1 widens the band.
widened AS (
    SELECT
        *,
        least(greatest(1 - residual_of_steps / residual / 2 + 2 / n, 0), 0.9) AS autocorrelation,
        CASE quantity WHEN 'capacity' THEN greatest(residual / (n - 2), 1)
            ELSE residual / (n - 2) * (1 + autocorrelation) / (1 - autocorrelation) END AS factor
    FROM lines
)
SELECT
    pack, quantity, n, first_day, last_day, middle, mean, slope,
    sqrt(factor / s) AS mean_std,
    sqrt(factor / tt) AS slope_std,
    mean - slope * middle AS today,
    sqrt(factor / s + factor / tt * middle ^ 2) AS today_std,
    -- 97.5 % quantile of Student's t with n - 2 degrees of freedom (Cornish-Fisher expansion); 1.96 is that of the normal
    -- distribution
    1.96 + 2.37 / (n - 2) + 2.82 / (n - 2) ^ 2 AS t_quantile
FROM widened
