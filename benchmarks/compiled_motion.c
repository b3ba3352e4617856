/* A mass, damper, spring and Bouc-Wen friction driven by a force: Runge and Kutta's fourth order.

   drive: at every half step, 2 n substeps + 1 values; x: the displacement at n + 1 samples;
   p: sigma, q, p, mass, damping, stiffness, initial displacement, velocity and friction force. */
#include <math.h>

static void rates(const double *y, double drive, const double *p, double *d)
{
    double ahead = y[1] < 0.0 ? -y[2] : y[2];
    double slope = p[0] - (ahead >= 0.0 ? p[1] : p[2]) * ahead;
    d[0] = y[1];
    d[1] = (drive - p[4] * y[1] - p[5] * y[0] - y[2]) / p[3];
    d[2] = slope * y[1];
}

void simulate(int n, int substeps, double interval, const double *drive, const double *p, double *x)
{
    double y[3] = {p[6], p[7], p[8]}, h = interval / substeps, a[3], b[3], c[3], d[3], at[3];
    x[0] = y[0];
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < substeps; j++, drive += 2) {
            rates(y, drive[0], p, a);
            for (int k = 0; k < 3; k++) at[k] = y[k] + 0.5 * h * a[k];
            rates(at, drive[1], p, b);
            for (int k = 0; k < 3; k++) at[k] = y[k] + 0.5 * h * b[k];
            rates(at, drive[1], p, c);
            for (int k = 0; k < 3; k++) at[k] = y[k] + h * c[k];
            rates(at, drive[2], p, d);
            for (int k = 0; k < 3; k++) y[k] += h / 6.0 * (a[k] + 2.0 * (b[k] + c[k]) + d[k]);
        }
        x[i + 1] = y[0];
    }
}
