-- Capacity trend of each type and pack, with its confidence band. Needs: packs, fits.
WITH each AS (
    SELECT type, pack, f.* EXCLUDE (pack), slope_std * t_quantile / 1.96 AS std FROM fits f JOIN packs USING (pack)
    WHERE quantity = 'capacity'
),
-- Variance of the slopes between the packs of a type, in excess of the errors of the slopes (DerSimonian and Laird)
spreads AS (
    SELECT
        type, count(*) AS packs,
        greatest(
            0,
            (sum(slope ^ 2 / std ^ 2) - sum(slope / std ^ 2) ^ 2 / sum(1 / std ^ 2) - (count(*) - 1))
            / nullif(sum(1 / std ^ 2) - sum(1 / std ^ 4) / sum(1 / std ^ 2), 0)
        ) AS spread_variance
    FROM each GROUP BY type
),
types AS (
    SELECT
        type, any_value(packs) AS packs, sqrt(any_value(coalesce(spread_variance, 0))) AS spread,
        sum(slope / (std ^ 2 + coalesce(spread_variance, 0))) / sum(1 / (std ^ 2 + coalesce(spread_variance, 0))) AS slope,
        sqrt(1 / sum(1 / (std ^ 2 + coalesce(spread_variance, 0)))) AS std,
        avg(exp(today)) AS capacity_ratio, max(last_day - first_day + 1) AS days
    FROM each JOIN spreads USING (type) GROUP BY type
)
SELECT
    type, NULL AS pack, packs, days,
    capacity_ratio, NULL AS capacity_ratio_low, NULL AS capacity_ratio_high,
    100 * slope AS percent_per_year, 100 * (slope - 1.96 * std) AS percent_per_year_low,
    100 * (slope + 1.96 * std) AS percent_per_year_high, 100 * spread AS percent_per_year_spread
FROM types
UNION ALL
SELECT
    type, pack, 1, last_day - first_day + 1,
    exp(today), exp(today - t_quantile * today_std), exp(today + t_quantile * today_std),
    100 * slope, 100 * (slope - t_quantile * slope_std), 100 * (slope + t_quantile * slope_std), NULL
FROM each
ORDER BY pack IS NOT NULL, type, percent_per_year, pack
