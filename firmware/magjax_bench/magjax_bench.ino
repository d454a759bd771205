// magjax acquisition protocol, version 1 (docs/protocol.md), for a board with a DAC and 32-bit words (Due, Zero, Teensy 3.x, ...).
// DAC A0 -> amplifier's analog input; A1 <- its current monitor or a shunt; A2 <- displacement sensor. Bipolar signals sit at half scale.
// The drive is at zero at boot, after STOP, after the last sample, and when the host has been silent for WATCHDOG_MS.

const uint8_t VERSION = 1;
const uint8_t QUERY = 0x01, DRIVE = 0x02, GENERATE = 0x03, START = 0x04, STOP = 0x05, ALIVE = 0x06;
const uint8_t HELLO = 0x81, ACK = 0x82, DATA = 0x83, FINAL = 0x84;
const uint8_t BY_HOST = 0, ALL_SENT = 1, BY_WATCHDOG = 2;

const uint32_t RATE_MAX = 10000;      // samples/s that the loop below keeps up with; measure it on your board
const uint32_t WATCHDOG_MS = 2000;
const int FRAME = 32;                 // samples a DATA frame
const int TABLE = 4096;               // samples of drive that fit
const int MIDDLE = 2048;              // 12-bit converters, zero at half scale
const int LIMIT = 1900;               // counts of drive that the bench bears: set it for your amplifier
// Calibrate: amperes and micrometres a count of YOUR bench.
const char *CALIBRATION =
    "\"drive\":{\"unit\":\"A\",\"scale\":5e-4,\"limit\":0.95,\"table\":4096},"
    "\"channels\":[{\"name\":\"current\",\"unit\":\"A\",\"scale\":5e-4,\"offset\":0},"
    "{\"name\":\"displacement\",\"unit\":\"um\",\"scale\":0.025,\"offset\":50}]";

int16_t table[TABLE];
uint32_t tableLength = 0, filled = 0, repeats = 0;
bool running = false, ended = false;
uint32_t run = 0, bootId = 0, seq = 0, dropped = 0, heardAt = 0;
uint64_t samples = 0, wanted = 0;
uint32_t periodUs = 100, nextAt = 0;
uint8_t reason = 0;
int16_t block[FRAME][2];
int blockFill = 0;
uint64_t blockTime = 0;

// --- frames -----------------------------------------------------------------------------------------------------------------

uint32_t crc32(const uint8_t *p, size_t n) {
  uint32_t crc = 0xFFFFFFFF;
  while (n--) {
    crc ^= *p++;
    for (int k = 0; k < 8; k++) crc = (crc >> 1) ^ (0xEDB88320 & -(crc & 1));
  }
  return ~crc;
}

// Sends payload + CRC-32 as COBS with a zero behind it; false where the port has no room for it now.
bool sendFrame(uint8_t *payload, size_t n, bool mayDrop) {
  static uint8_t wire[1100];
  uint32_t crc = crc32(payload, n);
  memcpy(payload + n, &crc, 4);
  n += 4;
  size_t code = 0, at = 1;
  for (size_t k = 0; k < n; k++) {
    if (at - code == 0xFF) { wire[code] = 0xFF; code = at++; }  // 254 bytes without a zero: no zero is meant behind them
    if (payload[k]) { wire[at++] = payload[k]; continue; }
    wire[code] = at - code;
    code = at++;
  }
  wire[code] = at - code;
  wire[at++] = 0;
  if (mayDrop && (size_t)Serial.availableForWrite() < at) return false;
  Serial.write(wire, at);
  return true;
}

size_t decodeFrame(uint8_t *p, size_t n) {  // in place; length of the payload, 0 where it is damaged
  size_t in = 0, out = 0;
  while (in < n) {
    uint8_t code = p[in++];
    if (in + code - 1 > n) return 0;
    for (int k = 1; k < code; k++) p[out++] = p[in++];
    if (code < 0xFF && in < n) p[out++] = 0;
  }
  uint32_t crc;
  if (out < 6) return 0;
  memcpy(&crc, p + out - 4, 4);
  return crc == crc32(p, out - 4) ? out - 4 : 0;
}

// --- answers ----------------------------------------------------------------------------------------------------------------

void sendHello() {
  static uint8_t p[640];
  int n = snprintf((char *)p + 2, sizeof p - 8,
      "{\"protocol\":1,\"device\":\"magjax bench 1\",\"firmware\":\"1.0\",\"boot_id\":\"%08lx\",\"rate_max_Hz\":%lu,\"frame_samples\":%d,"
      "\"clock_bits\":32,\"watchdog_s\":%lu,\"running\":%s,%s,"
      "\"last\":{\"run\":%lu,\"reason\":%d,\"last_seq\":%lu,\"frames\":%lu,\"samples\":%lu,\"dropped\":%lu}}",
      (unsigned long)bootId, (unsigned long)RATE_MAX, FRAME, (unsigned long)(WATCHDOG_MS / 1000), running ? "true" : "false", CALIBRATION,
      (unsigned long)run, reason, (unsigned long)(seq - 1), (unsigned long)seq, (unsigned long)samples, (unsigned long)dropped);
  p[0] = HELLO; p[1] = VERSION;
  sendFrame(p, n + 2, false);
}

void sendAck(uint8_t command, uint8_t status, uint32_t value, const char *text) {
  uint8_t p[96] = {ACK, VERSION, command, status};
  memcpy(p + 4, &value, 4);
  size_t n = strlen(text);
  memcpy(p + 8, text, n);
  sendFrame(p, 8 + n, false);
}

void sendData() {
  static uint8_t p[16 + FRAME * 4 + 4];
  uint16_t n = blockFill;
  p[0] = DATA; p[1] = VERSION;
  memcpy(p + 2, &n, 2); memcpy(p + 4, &seq, 4); memcpy(p + 8, &blockTime, 8); memcpy(p + 16, block, n * 4);
  if (!sendFrame(p, 16 + n * 4, true)) dropped++;
  seq++;
  blockFill = 0;
}

void sendFinal() {
  uint8_t p[40] = {FINAL, VERSION, reason};
  uint32_t last = seq - 1;
  uint64_t frames = seq;
  memcpy(p + 3, &run, 4); memcpy(p + 7, &last, 4); memcpy(p + 11, &frames, 8); memcpy(p + 19, &samples, 8); memcpy(p + 27, &dropped, 4);
  sendFrame(p, 31, false);
}

// --- the run ----------------------------------------------------------------------------------------------------------------

void output(int counts) { analogWrite(A0, MIDDLE + constrain(counts, -LIMIT, LIMIT)); }

void finish(uint8_t why) {
  output(0);
  if (running && blockFill) sendData();
  running = false; ended = true; reason = why;
  sendFinal();
}

void sample() {
  bool playing = tableLength && (repeats == 0 || samples < (uint64_t)repeats * tableLength);
  output(playing ? table[samples % tableLength] : 0);
  if (blockFill == 0) blockTime = micros();  // 32 bits: HELLO says so, the host unwraps
  block[blockFill][0] = analogRead(A1) - MIDDLE;
  block[blockFill][1] = analogRead(A2) - MIDDLE;
  blockFill++; samples++;
  if (blockFill == FRAME) sendData();
  if (wanted && samples >= wanted) finish(ALL_SENT);
}

void receive(uint8_t *p, size_t n) {
  heardAt = millis();
  uint8_t kind = p[0];
  if (p[1] != VERSION) { sendAck(kind, 1, 0, "protocol version is not 1"); return; }
  if (kind == QUERY) sendHello();
  else if (kind == STOP) { if (running || !ended) finish(BY_HOST); else sendFinal(); }
  else if (kind == DRIVE && n >= 14) {
    uint32_t start, total, times, count = (n - 14) / 2;
    memcpy(&start, p + 2, 4); memcpy(&total, p + 6, 4); memcpy(&times, p + 10, 4);
    if (running) { sendAck(kind, 1, 0, "a run is on; STOP first"); return; }
    if (total > TABLE || start + count > total || start > filled) { sendAck(kind, 1, 0, "the table does not fit"); return; }
    if (start == 0) filled = 0;
    memcpy(table + start, p + 14, 2 * count);
    for (uint32_t k = start; k < start + count; k++)
      if (abs(table[k]) > LIMIT) { tableLength = 0; sendAck(kind, 1, 0, "beyond the device's limit"); return; }
    tableLength = total; repeats = times;
    if (start + count > filled) filled = start + count;
    sendAck(kind, 0, start, "");
  } else if (kind == GENERATE && n >= 18) {
    uint32_t width, periods; int16_t amplitude, offset; float factor;
    memcpy(&width, p + 2, 4); memcpy(&periods, p + 6, 4); memcpy(&amplitude, p + 10, 2); memcpy(&offset, p + 12, 2); memcpy(&factor, p + 14, 4);
    uint32_t length = factor == 1.0f ? width : width * periods;
    if (running || width < 4 || length > TABLE || abs(amplitude) + abs(offset) > LIMIT) { sendAck(kind, 1, 0, "does not fit"); return; }
    for (uint32_t k = 0; k < length; k++)
      table[k] = lround(offset + amplitude * pow(factor, (double)k / width) * sin(6.283185307179586 * k / width));
    tableLength = filled = length; repeats = factor == 1.0f ? periods : 1;
    sendAck(kind, 0, 0, "");
  } else if (kind == START && n >= 18) {
    uint32_t number, rate;
    char text[48];
    memcpy(&number, p + 2, 4); memcpy(&rate, p + 6, 4);
    snprintf(text, sizeof text, "{\"rate_Hz\":%.3f}", 1e6 / (rate ? 1000000000UL / rate : 1));
    if ((running || ended) && number == run) { sendAck(kind, 0, 0, text); return; }
    if (running || rate == 0 || rate > 1000UL * RATE_MAX || filled < tableLength) { sendAck(kind, 1, 0, "not ready, or too fast"); return; }
    memcpy(&wanted, p + 10, 8);
    run = number; periodUs = 1000000000UL / rate;  // whole microseconds: the true rate is in the ACK
    seq = dropped = 0; samples = 0; blockFill = 0; ended = false;
    sendAck(kind, 0, 0, text);
    nextAt = micros() + periodUs; running = true;
  } else if (kind != ALIVE) sendAck(kind, 1, 0, "unknown packet");
}

void setup() {
  analogWriteResolution(12);
  analogReadResolution(12);
  output(0);
  Serial.begin(2000000);
  randomSeed(analogRead(A3) + micros());
  bootId = random(0x7FFFFFFF);
  sendHello();
}

void loop() {
  static uint8_t in[320];
  static size_t fill = 0;
  while (Serial.available()) {
    uint8_t byte = Serial.read();
    if (byte) { if (fill < sizeof in) in[fill++] = byte; continue; }
    size_t n = fill ? decodeFrame(in, fill) : 0;
    fill = 0;
    if (n) { receive(in, n); break; }  // at most one command between samples
  }
  if (running && (int32_t)(micros() - nextAt) >= 0) { nextAt += periodUs; sample(); }
  if (running && millis() - heardAt > WATCHDOG_MS) finish(BY_WATCHDOG);
}
