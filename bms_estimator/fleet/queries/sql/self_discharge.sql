-- Series cells whose deviation at rest falls over the days: least squares with the day and the SOC as regressors, because the
-- deviation of a cell with another capacity depends on the SOC. Needs: packs, cell_days.
WITH sums AS (
    SELECT
        pack, cell, count(*) AS n, max(day) AS last_day, min(day) AS first_day,
        count(*) * var_pop(day) AS tt, count(*) * var_pop(soc) AS ss, count(*) * covar_pop(day, soc) AS ts,
        count(*) * covar_pop(day, deviation_v) AS tv, count(*) * covar_pop(soc, deviation_v) AS sv,
        count(*) * var_pop(deviation_v) AS vv
    FROM cell_days
    GROUP BY pack, cell
    HAVING count(*) >= $min_days
),
-- the SOC is a regressor only if its standard deviation over the days exceeds 1 %
terms AS (
    SELECT *, CASE WHEN ss > 1e-4 * n THEN ts / ss ELSE 0 END AS t_on_s, CASE WHEN ss > 1e-4 * n THEN sv / ss ELSE 0 END AS v_on_s
    FROM sums
),
lines AS (
    SELECT *, (tv - t_on_s * sv) / nullif(tt - t_on_s * ts, 0) AS slope, tt - t_on_s * ts AS information FROM terms
),
-- the standard deviation of the residuals is at least 0.01 mV
trends AS (
    SELECT
        pack, cell, n, last_day - first_day + 1 AS days, slope,
        sqrt(greatest((vv - v_on_s * sv - slope ^ 2 * information) / (n - 3), 1e-10) / information) AS slope_std
    FROM lines
)
SELECT
    type, pack, cell, days, 1000 * slope AS mv_per_day, 1000 * slope_std AS mv_per_day_std, -slope / slope_std AS stds
FROM trends JOIN packs USING (pack)
WHERE slope < -$self_discharge_v AND -slope / slope_std > $stds
ORDER BY slope, pack, cell
