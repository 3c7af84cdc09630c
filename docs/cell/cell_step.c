/* Voltage of a cell by the tables that `bms-estimator cell convert` writes; the header's comment has the equations. */
#include <math.h>

#include CELL_HEADER /* -DCELL_HEADER='"cell.h"' */

typedef struct {
    float soc;
    float trend_soc;  /* m: filtered SOC */
    float hysteresis; /* h */
    float current_a[CELL_RC_PAIRS];
} cell_state_t;

/* Interpolate a table linearly, constant outside its nodes. */
static float interpolated(const CELL_MEMORY float *soc, const CELL_MEMORY float *values, int nodes, float at)
{
    int low = 0;
    int high = nodes - 1;
    if (at <= soc[low]) {
        return values[low];
    }
    if (at >= soc[high]) {
        return values[high];
    }
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (soc[middle] <= at) {
            low = middle;
        } else {
            high = middle;
        }
    }
    return values[low] + (values[high] - values[low]) * (at - soc[low]) / (soc[high] - soc[low]);
}

/* Set the state of a cell that has rested for hours after a charge. */
void cell_start(cell_state_t *state, float soc)
{
    state->soc = soc;
    state->trend_soc = soc;
    state->hysteresis = 1.0f;
    for (int k = 0; k < CELL_RC_PAIRS; k++) {
        state->current_a[k] = 0.0f;
    }
}

/*
 * Advance the state by dt_s [s] with the mean current over that time [A], positive on discharge.
 * dt_s should be at least 0.1: in single precision, shorter steps lose charge by rounding.
 */
void cell_step(cell_state_t *state, float mean_a, float dt_s)
{
    state->soc -= mean_a * dt_s / CELL_CAPACITY_AS;
    for (int k = 0; k < CELL_RC_PAIRS; k++) {
        state->current_a[k] = mean_a + (state->current_a[k] - mean_a) * expf(-dt_s / CELL_TAU_S[k]);
    }
    const float change = (1.0f - expf(-dt_s / CELL_TAU_S[CELL_TREND])) * (state->soc - state->trend_soc);
    const float decay = expf(-fabsf(change) / CELL_HYSTERESIS_SOC);
    state->trend_soc += change;
    state->hysteresis = decay * state->hysteresis + copysignf(1.0f - decay, change);
}

/* Return the terminal voltage [V] at a current [A] and a temperature [degC]. */
float cell_voltage(const cell_state_t *state, float current_a, float temperature_c)
{
    const float soc = state->soc;
    const float inverse_k = 1.0f / (temperature_c + 273.15f) - 1.0f / 298.15f;
    const float weak = expf(CELL_WEAK_K * inverse_k);
    const float strong = expf(CELL_STRONG_K * inverse_k);
    float voltage_v = interpolated(CELL_OCV_SOC, CELL_OCV_V, CELL_OCV_NODES, soc);
    voltage_v += (temperature_c - 25.0f) * interpolated(CELL_OCV_SOC, CELL_OCV_V_PER_K, CELL_OCV_NODES, soc);
    voltage_v += state->hysteresis * expf(CELL_HYSTERESIS_K * inverse_k) *
                 interpolated(CELL_OCV_SOC, CELL_HYSTERESIS_V, CELL_OCV_NODES, soc);
    for (int k = 0; k <= CELL_RC_PAIRS; k++) {
        const float ohm = weak * interpolated(CELL_OHM_SOC, CELL_WEAK_OHM[k], CELL_OHM_NODES, soc) +
                          strong * interpolated(CELL_OHM_SOC, CELL_STRONG_OHM[k], CELL_OHM_NODES, soc);
        voltage_v -= ohm * (k == 0 ? current_a : state->current_a[k - 1]);
    }
    return voltage_v;
}
