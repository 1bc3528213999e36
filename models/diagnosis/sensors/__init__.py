"""Sensor faults told from machine faults: what each channel's samples and what pairs of channels say."""

from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.finding import implicated
from models.diagnosis.sensors.reference import SensorReference, learn_sensor_reference
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

__all__ = ["FaultKind", "SensorFault", "SensorReference", "implicated", "learn_sensor_reference", "sensor_findings"]
