-- Packs in which one series cell has the lowest SOC in most hours of the recent days. Needs: hours, packs.
WITH recent AS (
    SELECT * FROM hours
    WHERE weakest_cell_soc_deviation IS NOT NULL AND hour // 24 > $today - $recent_days
),
totals AS (
    SELECT pack, count(*) AS hours, avg(cell_soc_spread) AS soc_spread FROM recent GROUP BY pack
),
cells AS (
    SELECT
        pack, weakest_cell AS cell, count(*) AS hours_weakest, avg(weakest_cell_soc_deviation) AS soc_deviation,
        avg(weakest_cell_resistance_ratio) AS resistance_ratio
    FROM recent GROUP BY pack, weakest_cell
)
SELECT type, pack, cell, hours_weakest / hours AS fraction, soc_deviation, soc_spread, resistance_ratio
FROM cells JOIN totals USING (pack) JOIN packs USING (pack)
WHERE hours_weakest > 0.5 * hours AND soc_deviation < -$weak_cell_soc
ORDER BY soc_deviation, pack
