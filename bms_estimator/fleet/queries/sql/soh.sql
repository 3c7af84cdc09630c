-- Needs: packs, fits.
WITH each AS (
    SELECT type, pack, f.* EXCLUDE (pack), slope_std * reach / 1.96 AS std FROM fits f JOIN packs USING (pack)
    WHERE quantity = 'capacity'
),
-- Packs of a type differ: their slopes spread by ``apart`` beyond their errors (DerSimonian and Laird)
alike AS (
    SELECT
        type, count(*) AS packs,
        greatest(
            0,
            (sum(slope ^ 2 / std ^ 2) - sum(slope / std ^ 2) ^ 2 / sum(1 / std ^ 2) - (count(*) - 1))
            / nullif(sum(1 / std ^ 2) - sum(1 / std ^ 4) / sum(1 / std ^ 2), 0)
        ) AS apart
    FROM each GROUP BY type
),
types AS (
    SELECT
        type, any_value(packs) AS packs, sqrt(any_value(coalesce(apart, 0))) AS spread,
        sum(slope / (std ^ 2 + coalesce(apart, 0))) / sum(1 / (std ^ 2 + coalesce(apart, 0))) AS slope,
        sqrt(1 / sum(1 / (std ^ 2 + coalesce(apart, 0)))) AS std,
        avg(exp(today)) AS capacity_ratio, max(last_day - first_day + 1) AS days
    FROM each JOIN alike USING (type) GROUP BY type
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
    exp(today), exp(today - reach * today_std), exp(today + reach * today_std),
    100 * slope, 100 * (slope - reach * slope_std), 100 * (slope + reach * slope_std), NULL
FROM each
ORDER BY pack IS NOT NULL, type, percent_per_year, pack
