-- One row per day, pack and series cell: mean deviation from the mean of the cells at rest, and the mean SOC of these hours.
-- Needs: hours.
CREATE TEMP TABLE cell_days AS
SELECT pack, day, cell, avg(deviation_v)::DOUBLE AS deviation_v, avg(soc)::DOUBLE AS soc
FROM (
    SELECT
        pack, hour // 24 AS day, soc, unnest(cells_rest_v) AS deviation_v,
        unnest(range(1, len(cells_rest_v)::BIGINT + 1)) AS cell
    FROM hours
    WHERE cells_rest_v IS NOT NULL AND soc IS NOT NULL
)
GROUP BY pack, day, cell
