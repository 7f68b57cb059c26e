/* The equations of torch_denkf.applications.imu in plain C, for learning its numbers: a trial takes ten milliseconds.
 * State of errors: rotation 0, in the world's axes; bias of the gyro 3, its matrix of errors 6; position 15, velocity 18,
 * acceleration 21 in the body's axes; bias of the magnetometer 24, field northwards 27 and upwards 28, lag of the
 * magnetometer 29, stray field 30 and lever 33 in the body's axes. */
#include <math.h>
#include <string.h>
#define N 36
enum { BIAS = 3, GYRO = 6, POSITION = 15, PUSH = 21, HARD = 24, NORTH = 27, UP = 28, LAG = 29, STRAY = 30, LEVER = 33 };

static void product(const double *a, const double *b, double *o) {
    double w = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
    double x = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
    double y = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
    double z = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
    double n = 1 / sqrt(w * w + x * x + y * y + z * z);
    o[0] = w * n, o[1] = x * n, o[2] = y * n, o[3] = z * n;
}
static void exponential(const double *v, double *o) {
    double a = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), s = a < 1e-8 ? 0.5 : sin(a / 2) / a;
    o[0] = cos(a / 2), o[1] = s * v[0], o[2] = s * v[1], o[3] = s * v[2];
}
static void matrix(const double *q, double R[3][3]) {
    double w = q[0], x = q[1], y = q[2], z = q[3];
    double M[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                      {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                      {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
    memcpy(R, M, sizeof M);
}
static void skew(const double *v, double K[3][3]) {
    double M[3][3] = {{0, -v[2], v[1]}, {v[2], 0, -v[0]}, {-v[1], v[0], 0}};
    memcpy(K, M, sizeof M);
}
static void times(double A[3][3], double B[3][3], double C[3][3]) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) C[i][j] = A[i][0] * B[0][j] + A[i][1] * B[1][j] + A[i][2] * B[2][j];
}
static void cross(const double *a, const double *b, double *o) {
    o[0] = a[1] * b[2] - a[2] * b[1], o[1] = a[2] * b[0] - a[0] * b[2], o[2] = a[0] * b[1] - a[1] * b[0];
}
static void left_jacobian(const double *v, double J[3][3]) {
    double s = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], a = sqrt(s), K[3][3], square[3][3];
    double one = s < 1e-6 ? 0.5 - s / 24 : (1 - cos(a)) / s, two = s < 1e-6 ? 1. / 6 - s / 120 : (a - sin(a)) / (s * a);
    skew(v, K), times(K, K, square);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) J[i][j] = (i == j) + one * K[i][j] + two * square[i][j];
}
static void update(double P[N][N], double H[3][N], const double *r, const double *noise, double *q, double *x) {
    double PH[3][N], S[3][3], I[3][3], K[N][3], change[N];
    memset(PH, 0, sizeof PH);
    for (int a = 0; a < 3; a++)
        for (int j = 0; j < N; j++)
            if (H[a][j] != 0)
                for (int i = 0; i < N; i++) PH[a][i] += P[j][i] * H[a][j];
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) {
            S[a][b] = a == b ? noise[a] : 0;
            for (int j = 0; j < N; j++) S[a][b] += H[a][j] * PH[b][j];
        }
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) {
            int a1 = (a + 1) % 3, a2 = (a + 2) % 3, b1 = (b + 1) % 3, b2 = (b + 2) % 3;
            I[b][a] = S[a1][b1] * S[a2][b2] - S[a1][b2] * S[a2][b1];
        }
    double size = S[0][0] * I[0][0] + S[0][1] * I[1][0] + S[0][2] * I[2][0];
    for (int i = 0; i < N; i++)
        for (int a = 0; a < 3; a++) K[i][a] = (PH[0][i] * I[0][a] + PH[1][i] * I[1][a] + PH[2][i] * I[2][a]) / size;
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) P[i][j] -= K[i][0] * PH[0][j] + K[i][1] * PH[1][j] + K[i][2] * PH[2][j];
    for (int i = 0; i < N; i++) change[i] = K[i][0] * r[0] + K[i][1] * r[1] + K[i][2] * r[2];
    double turn[4], now[4], J[3][3];
    exponential(change, turn), product(turn, q, now), memcpy(q, now, sizeof now), left_jacobian(change, J);
    for (int i = 3; i < N; i++) x[i] += change[i];
    for (int j = 0; j < N; j++) {
        double v[3] = {P[0][j], P[1][j], P[2][j]};
        for (int i = 0; i < 3; i++) P[i][j] = J[i][0] * v[0] + J[i][1] * v[1] + J[i][2] * v[2];
    }
    for (int j = 0; j < N; j++) {
        double v[3] = {P[j][0], P[j][1], P[j][2]};
        for (int i = 0; i < 3; i++) P[j][i] = J[i][0] * v[0] + J[i][1] * v[1] + J[i][2] * v[2];
    }
}

/* Moves errors, or columns of a covariance, by the turn D: e are the errors of the turn that those of the gyro make. */
static void moved(double P[N][N], const double *x, const double *w, double dt, const double *moves, double fades,
                  double D[3][3], double J[3][3], double A[3][3]) {
    static double e[3][N], phi[3][N], v[4][3][N];
    for (int l = 0; l < 3; l++) {
        int m = GYRO + 3 * l;
        for (int j = 0; j < N; j++)
            e[l][j] = -dt * (P[BIAS + l][j] + w[0] * P[m][j] + w[1] * P[m + 1][j] + w[2] * P[m + 2][j]);
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < N; j++) {
            P[i][j] += A[i][0] * e[0][j] + A[i][1] * e[1][j] + A[i][2] * e[2][j];
            phi[i][j] = J[i][0] * e[0][j] + J[i][1] * e[1][j] + J[i][2] * e[2][j];
            double s[3] = {P[POSITION + i][j], P[POSITION + 3 + i][j], P[PUSH + i][j]};
            for (int k = 0; k < 3; k++) v[k][i][j] = moves[3 * k] * s[0] + moves[3 * k + 1] * s[1] + moves[3 * k + 2] * s[2];
            v[3][i][j] = fades * P[STRAY + i][j];
        }
    for (int k = 0; k < 4; k++)
        for (int i = 0; i < 3; i++) {
            int at = k < 3 ? POSITION + 3 * k : STRAY, next = (i + 1) % 3, last = (i + 2) % 3;
            for (int j = 0; j < N; j++)
                P[at + i][j] = D[0][i] * v[k][0][j] + D[1][i] * v[k][1][j] + D[2][i] * v[k][2][j]
                               + x[at + next] * phi[last][j] - x[at + last] * phi[next][j];
        }
}

/* p: gyro, gyro_rate, gyro_walk, damping, motion, motion_unrest, accelerometer, magnetometer, magnetometer_rate,
 * magnetic_walk, field_walk, rest, gravity, stray, stray_unrest, stray_time, lever_walk; start: 36 standard deviations;
 * state: 37 numbers. Writes orientations [T, 4], their covariances [T, 9] about the world's axes, and states [T, 36], whose
 * first three numbers are none. */
void filter(int count, double dt, const double *gyro, const double *force, const double *field, const double *unrest,
            const double *disturbance, const double *lever, const unsigned char *rest, int nine, const double *moves,
            const double *p, const double *start, const double *state, double *orientation, double *cov, double *states) {
    double P[N][N], q[4], x[N], R[3][3], J[3][3], A[3][3], D[3][3], turn[4], now[4];
    memset(P, 0, sizeof P), memcpy(q, state, sizeof q), memcpy(x + 3, state + 4, (N - 3) * sizeof(double));
    double fades = exp(-dt / p[15]);
    for (int i = 0; i < N; i++) P[i][i] = start[i] * start[i];
    for (int t = 0; t < count; t++) {
        const double *w = gyro + 3 * t;
        double speed = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
        if (t) {
            double angles[3], back[3], mixed[4][3];
            for (int i = 0; i < 3; i++) {
                const double *m = x + GYRO + 3 * i;
                angles[i] = (w[i] - x[BIAS + i] - m[0] * w[0] - m[1] * w[1] - m[2] * w[2]) * dt, back[i] = -angles[i];
            }
            exponential(angles, turn), product(q, turn, now), memcpy(q, now, sizeof now), matrix(turn, D);
            matrix(q, R), left_jacobian(back, J), times(R, J, A);
            for (int i = 0; i < 3; i++) {
                double v[3] = {x[POSITION + i], x[POSITION + 3 + i], x[PUSH + i]};
                for (int k = 0; k < 3; k++) mixed[k][i] = moves[3 * k] * v[0] + moves[3 * k + 1] * v[1] + moves[3 * k + 2] * v[2];
                mixed[3][i] = fades * x[STRAY + i];
            }
            for (int k = 0; k < 4; k++)
                for (int i = 0; i < 3; i++)
                    x[(k < 3 ? POSITION + 3 * k : STRAY) + i] = D[0][i] * mixed[k][0] + D[1][i] * mixed[k][1] + D[2][i] * mixed[k][2];
            moved(P, x, w, dt, moves, fades, D, J, A);
            for (int i = 0; i < N; i++)
                for (int j = 0; j < i; j++) {
                    double v = P[i][j];
                    P[i][j] = P[j][i], P[j][i] = v;
                }
            moved(P, x, w, dt, moves, fades, D, J, A); /* of the transpose */
            double stray = p[13] * p[13] + p[14] * p[14] * disturbance[t] * disturbance[t];
            for (int i = 0; i < 3; i++) {
                P[i][i] += (p[0] * p[0] + p[1] * p[1] * speed) * dt;
                P[BIAS + i][BIAS + i] += p[2] * p[2] * dt;
                P[PUSH + i][PUSH + i] += p[3] * (p[4] * p[4] + p[5] * p[5] * unrest[t] * unrest[t]) * dt;
                P[HARD + i][HARD + i] += p[9] * p[9] * dt, P[LEVER + i][LEVER + i] += p[16] * p[16] * dt;
                P[STRAY + i][STRAY + i] += stray * (1 - fades * fades);
            }
            P[NORTH][NORTH] += p[10] * p[10] * dt, P[UP][UP] += p[10] * p[10] * dt;
        }
        for (int k = 0; k < 3; k++) {
            if ((k == 1 && !nine) || (k == 2 && !rest[t])) continue;
            double H[3][N], r[3], noise[3], G[3][3], W[3][3], lag = x[LAG];
            memset(H, 0, sizeof H), matrix(q, R), skew(w, W);
            if (k == 0)
                for (int a = 0; a < 3; a++) {
                    r[a] = force[3 * t + a] - R[2][a] * p[12], noise[a] = p[6] * p[6];
                    H[a][0] = p[12] * R[1][a], H[a][1] = -p[12] * R[0][a];
                    H[a][PUSH + a] = 1, r[a] -= x[PUSH + a];
                    for (int i = 0; i < 3; i++) {
                        double arm = lever[9 * t + 3 * a + i];
                        H[a][LEVER + i] = arm, r[a] -= arm * x[LEVER + i];
                    }
                }
            if (k == 1) {
                double u[3], c[3];
                for (int a = 0; a < 3; a++)
                    for (int i = 0; i < 3; i++) {
                        G[a][i] = R[i][a]; /* to the body's axes as they were when the magnetometer read */
                        for (int l = 0; l < 3; l++) G[a][i] += lag * W[a][l] * R[i][l];
                    }
                for (int i = 0; i < 3; i++) u[i] = R[1][i] * x[NORTH] + R[2][i] * x[UP] + x[STRAY + i];
                cross(w, u, c);
                for (int a = 0; a < 3; a++) {
                    H[a][0] = G[a][1] * x[UP] - G[a][2] * x[NORTH], H[a][1] = -G[a][0] * x[UP], H[a][2] = G[a][0] * x[NORTH];
                    for (int i = 0; i < 3; i++) H[a][STRAY + i] = (a == i) + lag * W[a][i];
                    H[a][NORTH] = G[a][1], H[a][UP] = G[a][2], H[a][HARD + a] = 1, H[a][LAG] = c[a];
                    r[a] = field[3 * t + a] - u[a] - lag * c[a] - x[HARD + a];
                    noise[a] = p[7] * p[7] + p[8] * p[8] * speed;
                }
            }
            if (k == 2)
                for (int a = 0; a < 3; a++) H[a][BIAS + a] = 1, r[a] = w[a] - x[BIAS + a], noise[a] = p[11] * p[11];
            update(P, H, r, noise, q, x);
        }
        memcpy(orientation + 4 * t, q, sizeof q);
        for (int i = 0; i < 9; i++) cov[9 * t + i] = P[i / 3][i % 3];
        memcpy(states + N * t + 3, x + 3, sizeof x - 3 * sizeof(double));
    }
}
